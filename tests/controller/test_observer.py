"""The observer, its flows and the valves' inverse, over random numbers and in closed loop."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.controller import records as r
from softloop.controller.config import ControllerConfig
from softloop.controller.flows import carried, remember_flow, supplied
from softloop.controller.observer import double_pole, trust
from softloop.controller.setup import build
from softloop.controller.valve_drive import current_to_feel, play_after
from softloop.dynamics.parameters import load_parameters, model_record, shipped
from softloop.offline.closed_loop import simulate_run
from softloop.plant.config import LoadConfig, PlantConfig
from softloop.plant.mismatch import draw
from softloop.wire.kernel import new_record

PERIOD_S = 0.005
MODEL = model_record(load_parameters(shipped()))
FLOWS = st.lists(st.floats(-300, 300), min_size=r.N_FLOWS, max_size=r.N_FLOWS)
TIMES = st.floats(-0.15, 0.05)
PAST = st.floats(-PERIOD_S * (r.N_FLOWS - 8), 0.0, exclude_min=True, exclude_max=True)  # of which all flows are remembered


def with_flows(flows):
    observer = new_record(r.OBSERVER_STATE)
    observer.flow_kpa_s[:] = flows
    return observer


def flow_at(flows, time_s):
    """By the definition: command j acts since -j periods, the newest on."""
    return flows[0] if time_s >= 0 else flows[min(int(np.ceil(-time_s / PERIOD_S)), r.N_FLOWS - 1)]


@given(FLOWS, TIMES, TIMES)
def test_supplied_is_the_integral_of_the_flows(flows, start, end):
    grid = np.linspace(start, end, 4001)
    middles = 0.5 * (grid[1:] + grid[:-1])
    expected = sum(flow_at(flows, t) for t in middles) * (end - start) / 4000
    assert supplied(with_flows(flows), PERIOD_S, start, end) == pytest.approx(expected, abs=0.05)


@given(FLOWS, TIMES, TIMES, TIMES)
def test_supplied_adds_up_and_turns_its_sign(flows, a, b, c):
    observer = with_flows(flows)
    whole = supplied(observer, PERIOD_S, a, c)
    assert supplied(observer, PERIOD_S, a, b) + supplied(observer, PERIOD_S, b, c) == pytest.approx(whole, abs=1e-9)
    assert supplied(observer, PERIOD_S, c, a) == -whole


@given(FLOWS, st.integers(1, 6), st.floats(-300, 300), PAST, PAST)
def test_a_tick_later_the_past_is_the_same(flows, ticks, new, start, end):
    before, after = with_flows(flows), with_flows(flows)
    remember_flow(after, new, ticks)
    later = ticks * PERIOD_S
    held = supplied(before, PERIOD_S, start, end)
    assert supplied(after, PERIOD_S, start - later, end - later) == pytest.approx(held, abs=1e-9)
    assert supplied(after, PERIOD_S, 0.0, 0.01) == pytest.approx(0.01 * new)


def test_carrying_the_state_meets_a_fine_integration():
    observer = with_flows([50.0] * r.N_FLOWS)
    observer.disturbance_deg_s2 = 100.0
    one = carried(observer, MODEL.theta, PERIOD_S, 80.0, 20.0, 60.0, 0.0, 0.05)
    fine = (80.0, 20.0, 60.0)
    for k in range(5000):
        fine = carried(observer, MODEL.theta, PERIOD_S, *fine, k * 1e-5, (k + 1) * 1e-5)
    assert one == pytest.approx(fine, rel=1e-4)


@given(st.floats(1, 300), st.floats(0.001, 0.02))
def test_the_gains_put_both_poles_where_they_should_be(bandwidth, seconds):
    near, cause = double_pole(bandwidth, seconds)
    # value+ = value + T cause - near e, cause+ = cause - cause_gain e, with e of the predicted value
    step = np.array([[1.0 - near, (1.0 - near) * seconds], [-cause, 1.0 - cause * seconds]])
    pole = np.exp(-bandwidth * seconds)
    assert np.trace(step) == pytest.approx(2 * pole, abs=1e-9)
    assert np.linalg.det(step) == pytest.approx(pole**2, abs=1e-9)


@given(st.floats(0, 220), st.floats(0, 220), st.floats(0, 15), st.floats(0, 5), st.floats(0, 220))
def test_the_inverse_of_the_play_makes_the_spool_feel_what_is_wanted(wanted, felt, half, still, before):
    current = current_to_feel(wanted, felt, half, still, before)
    assert abs(play_after(current, felt, half) - wanted) <= still + 1e-9


def test_a_model_that_errs_alike_in_every_sample_is_not_trusted():
    gains = new_record(r.OBSERVER_GAINS)
    observer = new_record(r.OBSERVER_STATE)
    observer.innovation_power, observer.innovation_pair = 1.0, 0.9
    assert trust(gains, observer) == 1.0  # no gate
    gains.whiteness = 0.5
    assert trust(gains, observer) == 0.0
    observer.innovation_pair = -0.1
    assert trust(gains, observer) == 1.0
    observer.innovation_pair = 0.375
    assert 0.0 < trust(gains, observer) < 1.0


@pytest.fixture(scope="module")
def run():
    controller = ControllerConfig.model_validate(
        {"law": "arc_eso", "trajectory": "t1", "actuation": {"modes": "latched", "flow_hold_kpa_s": 25.0}}
    )
    load = LoadConfig(kind="payload", on_s=4.2 + 12.5, size=406.2)
    return simulate_run(controller, PlantConfig(seed=3, loads=(load,)))


def test_the_disturbance_is_found_within_a_tenth_of_a_second(run):
    came = int(np.flatnonzero(np.diff(run.truths["load"].astype(int)) > 0)[0])
    found = run.cycles["disturbance_deg_s2"]
    step = found[came + 20 : came + 60].mean() - found[came - 40 : came].mean()
    assert step == pytest.approx(-400.0, rel=0.15)  # less what hysteresis takes back


def test_the_gyros_bias_is_found(run):
    assert run.cycles["estimator"][2000:, 3].mean() == pytest.approx(draw(3).gyro_bias_deg_s, abs=0.1)


def test_angle_and_rate_are_those_of_the_time_of_action(run):
    track = run.cycles["trajectory_ns"] > 0
    truth = run.truths["angle_deg"]
    late = np.abs(run.cycles["angle_estimate_deg"][:-1] - truth[1:])[track[:-1]]  # a tick ahead is nearer than now
    assert late.max() < 0.3
    assert np.abs(run.cycles["rate_estimate_deg_s"] - run.truths["rate_deg_s"])[track].max() < 8.0


def test_a_payload_moves_it_little_and_is_over_soon(run):
    error = np.abs(run.truths["angle_deg"] - run.cycles["reference_deg"])
    came = int(np.flatnonzero(np.diff(run.truths["load"].astype(int)) > 0)[0])
    assert error[came : came + 200].max() < 1.5
    assert error[came + 200 : came + 400].max() < 0.5


def test_laws_without_the_observer_are_given_the_samples_carried_on():
    assert build(ControllerConfig(law="smc")).config[0].observe == 0
    assert build(ControllerConfig(law="pid_eso")).config[0].observe == 1
