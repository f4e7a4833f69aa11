"""Re-arming: after a fault in the middle of a trajectory neither command nor angle jumps, whatever the law.

    python -m tests.campaigns.rearm [--rigs 100] [--seed 1] [--json FILE]

Each rig, drawn by its seed, loses its pressure sensor for 0.1 s at a random moment of its trajectory, under each law in turn.
The gate goes to FAULT and vents, and is armed again at a random moment of the fall, or once the rig has come to rest. Of the
approach that follows, bounds are asked for: of both currents on its first tick, of the plant's own angle (or pressure) against
the reference in its first second, and of the time from the arm request to its beginning.
"""

import random
import sys

import numpy as np

from softloop.controller.config import ControllerConfig
from softloop.controller.records import CYCLE, PHASE_APPROACH
from softloop.devices.gate import GATE_FAULT
from softloop.offline.closed_loop import RigTables, link_record, ready_controller
from softloop.offline.loop_kernels import SHUTDOWN_FRAMES, simulate
from softloop.offline.loop_records import BETWEEN, INCLINATION, PRESSURE, TRUTH, VALVE_STATUS, no_records
from softloop.plant.config import FaultConfig, PlantConfig
from softloop.plant.records import EVENT
from softloop.plant.setup import WireTimes, new_device, new_state, plant_record
from softloop.wire.kernel import new_record
from softloop.wire.schedule import PERIOD_NS, START_NS, make_schedule
from tests.campaigns.outcome import Outcome, carried_out, options, steps

LAWS = ("arc", "smc", "pid", "arc_eso", "pid_eso", "pressure")
FAULT_S = (8.0, 28.0)  # of the plant's time: on the trajectory of all
SILENT_S, SETTLE_S, SEEN_S = 0.1, 0.5, 1.0
# The bounds. Both valves are shut at the first tick: their opening currents lie above. Law pressure is held to that of the charge
# valve alone: it answers its sensor's noise at 0 kPa with the exhaust valve, which there has nothing to let out.
CHARGE_MA, EXHAUST_MA = 75.0, 75.0
ANGLE_DEG, PRESSURE_KPA = 5.0, 5.0  # of the pressure, which has a law without an integral, in the first 0.1 s
WAIT_S = 1.0


class Rig:
    """A controller, a gate and a plant that are driven in stretches; each begins with an arm request."""

    def __init__(self, law, seed, fault_s):
        trajectory = "excitation_1hz" if law == "pressure" else "t1"
        fault = FaultConfig(kind="analog_silent", on_s=fault_s, off_s=fault_s + SILENT_S)
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


def judge(outcome, name, law, cycles, truths, arm_after_s):
    """Hold the approach that follows an arm request to the bounds, and keep the largest of what was seen."""
    begun = np.flatnonzero(cycles["phase"] == PHASE_APPROACH)
    wait_s = (begun[0] + 1) * 1e-9 * PERIOD_NS - arm_after_s if begun.size else np.inf
    if not wait_s <= WAIT_S:
        outcome.fail(f"{name}: the approach begins {wait_s:.2f} s after the arm request")
        return
    first, pressure = begun[0], law == "pressure"
    seen = slice(first, first + round((0.1 if pressure else SEEN_S) * 1e9) // PERIOD_NS)
    real, wanted = ("chamber_pressure_kpa", "desired_pressure_kpa") if pressure else ("angle_deg", "reference_deg")
    off = float(np.abs(truths[real][seen] - cycles[wanted][seen]).max())
    bounds = [(f"off the reference, {'kPa' if pressure else 'deg'}", off, PRESSURE_KPA if pressure else ANGLE_DEG)]
    bounds += [("first charge, mA", cycles["charge_current_ma"][first], CHARGE_MA)]
    bounds += [] if pressure else [("first exhaust, mA", cycles["exhaust_current_ma"][first], EXHAUST_MA)]
    for what, value, bound in bounds:
        outcome.keep_largest(f"hundredths, largest under {law}: {what} (bound {bound:g})", 100.0 * value)
        if not value <= bound:
            outcome.fail(f"{name}: {what}: {value:.2f} is above {bound:g}")
    outcome.keep_largest(f"ms from arm request to approach, at most (bound {1e3 * WAIT_S:g})", 1e3 * wait_s)


def rearmed(outcome, law, seed, fault_s, arm_after_s):
    """One rig through its fault, and armed again."""
    rig, name = Rig(law, seed, fault_s), f"{law} rig {seed}, fault at {fault_s:.2f} s, armed again after {arm_after_s:.2f} s"
    _, _, statuses = rig.drive(SETTLE_S, fault_s + SILENT_S + 0.02)
    if statuses["gate"][-1] != GATE_FAULT:
        outcome.fail(f"{name}: the gate is not in FAULT")
        return
    cycles, truths, _ = rig.drive(arm_after_s, arm_after_s + WAIT_S + SEEN_S)
    outcome.count("armed again")
    judge(outcome, name, law, cycles, truths, arm_after_s)


def campaign(rigs, seed, outcome=None):
    """Run it; returns the outcome."""
    outcome, rng = outcome or Outcome("rearm"), random.Random(seed)
    for number in steps(range(rigs), "rigs"):
        for law in LAWS:
            fault_s = rng.uniform(*FAULT_S)
            for arm_after_s in (rng.uniform(0.0, 1.0), 6.0):
                rearmed(outcome, law, seed + number, fault_s, arm_after_s)
    return outcome


def main():
    given = options(__doc__, rigs=100).parse_args()
    return carried_out("rearm", given, lambda outcome: campaign(given.rigs, given.seed, outcome))


if __name__ == "__main__":
    sys.exit(main())
