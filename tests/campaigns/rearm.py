"""Re-arming: after a fault in the middle of a trajectory, neither command nor angle jumps, for any law.

    python -m tests.campaigns.rearm [--rigs 100] [--seed 1] [--json FILE]
"""

import numpy as np

from softloop.controller.config import ControllerConfig
from softloop.controller.records import CYCLE, PHASE_APPROACH
from softloop.offline.closed_loop import RigTables, link_record, ready_controller
from softloop.offline.loop_kernels import SHUTDOWN_FRAMES, simulate
from softloop.offline.loop_records import BETWEEN, INCLINATION, PRESSURE, TRUTH, VALVE_STATUS, no_records
from softloop.plant.config import FaultConfig, PlantConfig
from softloop.plant.records import EVENT
from softloop.plant.setup import WireTimes, new_device, new_state, plant_record
from softloop.wire.kernel import new_record
from softloop.wire.schedule import PERIOD_NS, START_NS, make_schedule

SETTLE_S = 0.5


class Rig:
    """A controller, a gate and a plant that are driven in stretches; each begins with an arm request."""

    def __init__(self, law, seed, fault_s):
        trajectory = "excitation_1hz" if law == "pressure" else "t1"
        fault = FaultConfig(kind="analog_silent", on_s=fault_s, off_s=fault_s + 0.1)
        self.tables = RigTables(ControllerConfig(law=law, trajectory=trajectory), PlantConfig(seed=seed, faults=(fault,)))
        self.built = ready_controller(self.tables.controller)
        bus = self.tables.can["can0"].bitrate
        self.params = plant_record(self.tables.plant, WireTimes(bus, bus))
        self.plant = new_state(self.params, new_device(self.tables.plant), START_NS)
        self.between = new_record(BETWEEN)
        self.between.analog.counter = -1

    def drive(self, arm_after_s, seconds):
        """(cycle records, truths, valve statuses) of the next `seconds`."""
        b, between = self.built, self.between
        link = link_record(self.tables, self.params, make_schedule(0.0, 1e6, 0.0))
        link.arm_ns = self.plant.reached_ns + round(1e9 * arm_after_s)
        ticks = round(1e9 * seconds) // PERIOD_NS
        cycles, statuses = np.zeros(ticks, CYCLE), np.zeros(ticks, VALVE_STATUS)
        begun = int(between.frame.seq == 0)  # the very first truth is that of the start
        truths = np.zeros(ticks + begun, TRUTH)
        between.truths = between.requests = 0
        # The gate forgets who asked before, and that its process was about to end: the next request is a new one.
        between.gate.requesters = between.given.shutdown = 0
        simulate(
            b.config[0], b.model[0], b.gains[0], b.plan.knots, b.plan.table, b.inputs[0], b.state[0], b.scratch[0], b.first[0],
            self.params, self.plant, np.zeros(64, EVENT), link, between, cycles, truths, statuses, no_records(PRESSURE),
            no_records(INCLINATION),
        )  # fmt: skip
        between.frame.seq -= SHUTDOWN_FRAMES
        return cycles, truths[begun:], statuses
