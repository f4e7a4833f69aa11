"""The tick as a whole: input health, phases, modes, saturation, and that it depends on nothing but its arguments."""

import copy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.controller import records as r
from softloop.controller.config import ControllerConfig
from softloop.controller.setup import PERIOD_NS, build
from softloop.controller.tick import reference_now
from softloop.wire.kernel import new_record

MS = 1_000_000
TRAJECTORIES = {"pressure": "excitation_1hz", "pressure_eso": "excitation_1hz", "valve_test": "valve_steps"}


def fed(controller, tick, **given):
    """The cycle record of a tick on inputs made of what is `given`."""
    prepare(controller, tick, **given)
    return controller.tick()


def prepare(controller, tick, armed=True, angle=26.75, pressure=0.5, age_ns=3 * MS, status=0, rate=0.0):
    inputs = controller.inputs[0]
    inputs.now_ns, inputs.tick, inputs.skipped = 10**9 + tick * PERIOD_NS, tick, 0
    inputs.pressure.seq = inputs.inclination.seq = inputs.valves.seq = tick + 1
    inputs.pressure.stamp_ns = inputs.inclination.stamp_ns = inputs.now_ns - age_ns
    inputs.pressure.supply_pressure_kpa, inputs.pressure.chamber_pressure_kpa = 200.0, pressure
    inputs.pressure.status = status
    inputs.inclination.angle_deg, inputs.inclination.rate_deg_s = angle, rate
    inputs.valves.gate = r.GATE_ARMED if armed else 0


def built(law):
    return build(ControllerConfig(law=law, trajectory=TRAJECTORIES.get(law, "t1"), approach_s=0.05))


@pytest.fixture(params=list(r.LAWS))
def law(request):
    return request.param


@pytest.fixture
def controller(law):
    return built(law)


def test_it_waits_until_armed_with_valid_inputs_then_approaches_tracks_and_ends(controller):
    controller.config[0].plan_ns = 20 * PERIOD_NS
    assert fed(controller, 0, armed=False).phase == r.PHASE_WAIT
    assert fed(controller, 1, status=1).phase == r.PHASE_WAIT
    phases = [int(fed(controller, k).phase) for k in range(2, 50)]
    assert phases == sorted(phases)
    assert phases.count(r.PHASE_APPROACH) == 10
    assert phases.count(r.PHASE_TRACK) == 20
    assert phases[-1] == r.PHASE_DONE
    last = controller.cycle[0]
    assert last.charge_current_ma == last.exhaust_current_ma == 0.0


def test_trajectory_time_counts_to_zero_through_the_approach(controller):
    cycles = [int(fed(controller, k).trajectory_ns) for k in range(15)]
    assert cycles == [-50 * MS + k * PERIOD_NS for k in range(15)]


def test_a_gate_that_disarms_sends_it_back_to_wait_with_no_current(controller):
    for k in range(5):
        fed(controller, k)
    cycle = fed(controller, 5, armed=False)
    assert cycle.phase == r.PHASE_WAIT
    assert cycle.charge_current_ma == cycle.exhaust_current_ma == 0.0


def test_rearming_begins_anew_from_what_is_measured(controller, law):
    for k in range(60):
        fed(controller, k, angle=40.0 + 0.1 * k, pressure=30.0 + 0.2 * k)
    for k in range(60, 63):  # the currents of two ticks count in the prediction
        fed(controller, k, armed=False)
    controller.state[0].theta[:] = controller.model[0].theta_max  # as if learned before the fault
    first = fed(controller, 63, angle=55.0, pressure=20.0)
    assert first.phase == r.PHASE_APPROACH
    fresh = built(law)
    fresh.state[0].last_ns = controller.inputs[0].now_ns - PERIOD_NS
    expected = fed(fresh, 63, angle=55.0, pressure=20.0)
    for name in (
        "theta",
        "charge_current_ma",
        "exhaust_current_ma",
        "reference_deg",
        "internal",
        "estimator",
        "mode",
        "adapting",
    ):
        np.testing.assert_array_equal(first[name], expected[name], err_msg=name)
    if law in r.ANGLE_LAWS:
        assert first.reference_deg == 55.0


def test_a_rig_that_still_falls_is_waited_for(controller):
    for k in range(10):
        cycle = fed(controller, k, rate=-10.1)
        assert cycle.phase == r.PHASE_WAIT
        assert cycle.charge_current_ma == cycle.exhaust_current_ma == 0.0
    assert fed(controller, 10, rate=-9.9).phase == r.PHASE_APPROACH
    assert fed(controller, 11, rate=-200.0).phase == r.PHASE_APPROACH


@pytest.mark.parametrize("what", ["pressure", "inclination", "both"])
def test_stale_inputs_are_said_and_stop_adaptation(controller, what):
    for k in range(5):
        assert fed(controller, k).inputs_valid
    inputs = controller.inputs[0]
    inputs.now_ns += 100 * MS
    if what == "pressure":
        inputs.inclination.stamp_ns += 100 * MS
    if what == "inclination":
        inputs.pressure.stamp_ns += 100 * MS
    cycle = controller.tick()
    assert not cycle.inputs_valid
    assert not cycle.adapting


@pytest.mark.parametrize("what", ["pressure", "inclination"])
def test_a_sensor_that_slows_down_stops_adaptation_until_it_is_back(what):
    controller = built("arc")
    controller.config[0].plan_ns = 10**12
    place = r.IN_PRESSURE_RATE_HZ if what == "pressure" else r.IN_INCLINATION_RATE_HZ

    def run(ticks, every):
        adapted = []
        for k in ticks:
            before = controller.inputs[0][what].copy()
            prepare(controller, k, angle=controller.cycle[0].reference_deg, pressure=controller.cycle[0].desired_pressure_kpa)
            if k % every:
                controller.inputs[0][what] = before  # the last sample still lies there, older than before
            cycle = controller.tick()
            assert cycle.inputs_valid
            adapted.append(bool(cycle.adapting))
        return adapted, cycle.internal[place]

    adapted, rate_hz = run(range(300), 1)
    assert rate_hz == 200.0
    assert any(adapted[150:])
    adapted, rate_hz = run(range(300, 1200), 3)
    assert rate_hz == pytest.approx(200.0 / 3, rel=0.05)
    assert not any(adapted[150:])
    adapted, rate_hz = run(range(1200, 1500), 1)
    assert rate_hz > 150.0
    assert any(adapted[150:])
    controller.config[0].input_rate_min_hz = 50.0
    assert any(run(range(1500, 1800), 3)[0][150:])


def test_one_valve_works_at_a_time_and_currents_stay_in_range(controller):
    rng = np.random.RandomState(2)
    for k in range(400):
        cycle = fed(controller, k, angle=rng.uniform(20, 150), pressure=rng.uniform(0, 150))
        assert 0.0 <= cycle.charge_current_ma <= 220.0
        assert 0.0 <= cycle.exhaust_current_ma <= 220.0
        closed = {r.MODE_CHARGE: cycle.exhaust_current_ma, r.MODE_EXHAUST: cycle.charge_current_ma}.get(int(cycle.mode), 0.0)
        assert closed < 80.0  # below any opening current
    model = controller.model[0]
    assert np.all(cycle.theta >= model.theta_min)
    assert np.all(cycle.theta <= model.theta_max)


@given(st.lists(st.tuples(st.floats(20, 150), st.floats(0, 150), st.booleans()), min_size=1, max_size=30))
def test_equal_inputs_give_equal_bytes(steps):
    runs = []
    for _ in range(2):
        one = build_cached()
        runs.append(
            b"".join(fed(one, k, armed=armed, angle=angle, pressure=p).tobytes() for k, (angle, p, armed) in enumerate(steps))
        )
    assert runs[0] == runs[1]


_FRESH = build(ControllerConfig(approach_s=0.05))


def build_cached():
    return copy.deepcopy(_FRESH)


@given(*[st.floats(allow_nan=True, allow_infinity=True)] * 4)
def test_no_number_on_the_inputs_makes_it_stop_or_ask_for_the_impossible(angle, rate, chamber, supply):
    one = build_cached()
    fed(one, 0)
    inputs = one.inputs[0]
    inputs.inclination.angle_deg, inputs.inclination.rate_deg_s = angle, rate
    inputs.pressure.chamber_pressure_kpa, inputs.pressure.supply_pressure_kpa = chamber, supply
    inputs.now_ns += PERIOD_NS
    cycle = one.tick()
    finite = all(np.isfinite(v) for v in (angle, rate, chamber, supply))
    if not finite:
        assert not cycle.inputs_valid
    for current in (cycle.charge_current_ma, cycle.exhaust_current_ma):
        assert np.isnan(current) or 0.0 <= current <= 220.0


@pytest.mark.parametrize("law", r.PRESSURE_LAWS)
def test_a_multi_sine_is_faded_in_and_never_leaves_the_range_between(law):
    """A polynomial with the multi-sine's derivatives at its end went below the room's pressure on its way."""
    controller = build(ControllerConfig(law=law, trajectory="excitation_1hz", approach_s=4.0))
    fed(controller, 0, pressure=0.5)
    start_ns, point = int(controller.state[0].phase_start_ns), new_record(r.REFERENCE)

    def at(time_s):
        reference_now(
            controller.config[0], controller.plan.knots, controller.plan.table, controller.state[0],
            start_ns + round(1e9 * time_s), point,
        )  # fmt: skip
        return np.array([point.value, point.rate, point.acceleration, point.jerk])

    values = np.array([at(t)[0] for t in np.arange(0.0, 6.0, 0.005)])
    assert values[0] == 0.5
    assert values.min() >= 0.5
    assert values.max() <= 110.0
    assert np.abs(at(0.0)[1:]).max() < 1e-6
    h = 1e-4
    for time_s in (0.5, 1.7, 2.9, 3.7, 3.99, 4.0, 4.5):
        here, numeric = at(time_s), (at(time_s + h) - at(time_s - h))[:3] / (2 * h)
        assert numeric == pytest.approx(here[1:], rel=1e-3, abs=2e-2)
