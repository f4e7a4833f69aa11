"""The state after a tick stands in the tick's record."""

import numpy as np
import pytest

from softloop.controller import records as r
from softloop.controller.config import ControllerConfig
from softloop.controller.recall import recall, recall_course
from softloop.controller.setup import PERIOD_NS, build

# Made anew in each tick before it is read, or never read.
NOT_STATE = {"arc", "started", "approach_ns"}


@pytest.fixture(params=list(r.LAWS))
def controller(request):
    trajectory = {"pressure": "excitation_1hz", "pressure_eso": "excitation_1hz", "valve_test": "valve_steps"}.get(
        request.param, "t1"
    )
    return build(ControllerConfig(law=request.param, trajectory=trajectory, approach_s=0.1))


def run(controller, ticks=120):
    """Wait, approach, disarmed, approach again, trajectory, end; yields the record of each tick."""
    controller.config[0].plan_ns = 40 * PERIOD_NS
    noise = np.random.RandomState(3)
    for tick in range(ticks):
        inputs = controller.inputs[0]
        inputs.now_ns, inputs.tick, inputs.skipped = 10**9 + tick * PERIOD_NS, tick, noise.randint(2)
        inputs.pressure.seq = inputs.inclination.seq = inputs.valves.seq = tick + 1
        inputs.pressure.stamp_ns = inputs.inclination.stamp_ns = inputs.now_ns - 2_000_000
        inputs.pressure.supply_pressure_kpa, inputs.pressure.chamber_pressure_kpa = 200.0, noise.uniform(0, 120)
        inputs.inclination.angle_deg, inputs.inclination.rate_deg_s = noise.uniform(30, 120), noise.uniform(-100, 100)
        inputs.valves.gate = r.GATE_ARMED if tick > 5 and not 15 <= tick < 20 else 0
        yield controller.tick()


def call(function, controller, cycle, state):
    function(controller.config[0], controller.plan.knots, controller.plan.table, cycle, state[0], controller.scratch[0])


def test_a_record_gives_the_state_back_in_every_phase(controller):
    phases = set()
    for cycle in run(controller):
        phases.add(int(cycle.phase))
        state = np.zeros(1, r.CONTROLLER_STATE)
        call(recall, controller, cycle, state)
        for name in set(state.dtype.names) - NOT_STATE:
            if name == "approach" and cycle.phase != r.PHASE_APPROACH:
                continue  # read in that phase alone
            if name == "phase_start_ns" and cycle.phase == r.PHASE_WAIT:
                continue  # set when waiting ends
            assert state[name].tobytes() == controller.state[name].tobytes(), (name, int(cycle.phase))
    assert phases == {r.PHASE_WAIT, r.PHASE_APPROACH, r.PHASE_TRACK, r.PHASE_DONE}


def test_the_course_alone_leaves_what_is_the_laws(controller):
    cycle = [c.copy() for c in run(controller, 60)][-1]
    state = np.zeros(1, r.CONTROLLER_STATE)
    state["theta"], state["charge_ma"], state["mode"] = 7.0, 5.0, 2
    call(recall_course, controller, cycle, state)
    assert state["phase"] == cycle.phase == r.PHASE_TRACK
    assert state["phase_start_ns"] == controller.state["phase_start_ns"]
    assert (state["theta"] == 7.0).all()
    assert (state["charge_ma"], state["mode"]) == (5.0, 2)


def test_an_approach_that_was_broken_off_does_not_go_on_in_the_log(controller):
    cycles = [c.copy() for c in run(controller, 20)]
    assert cycles[14].phase == r.PHASE_APPROACH
    assert all(c.phase == r.PHASE_WAIT for c in cycles[15:])
    values = [c.reference_rate_deg_s for c in cycles[15:]]
    assert all(v == 0.0 or np.isnan(v) for v in values)
