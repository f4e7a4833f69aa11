import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.controller import references
from softloop.controller.config import ControllerConfig
from softloop.controller.references import (
    T1_ANGLES_DEG,
    T2_SPAN_DEG,
    excitation,
    from_csv,
    multi_sine,
    point_to_point,
    smooth_move,
    t2,
    valve_steps,
)
from softloop.controller.setup import build, plan_of
from softloop.controller.tick import move_between
from softloop.wire.errors import BadConfig, BadFile

PLANS = {"t1": point_to_point(), "t2": t2(3), "excitation": excitation(1.0, 2)}


def derivatives_agree(plan, time_s):
    h = 1e-4
    here, up, down = (np.array(plan.at(time_s + d).tolist()) for d in (0.0, h, -h))
    numeric = (up - down)[:3] / (2 * h)
    return numeric == pytest.approx(here[1:], rel=1e-4, abs=2e-2)


@pytest.mark.parametrize("name", PLANS)
@given(share=st.floats(0.001, 0.999))
def test_rate_acceleration_and_jerk_are_derivatives(name, share):
    plan = PLANS[name]
    time_s = share * plan.duration_s
    assert derivatives_agree(plan, time_s)


def test_t1_dwells_four_seconds_at_each_angle_and_lasts_37():
    plan = PLANS["t1"]
    assert plan.duration_s == pytest.approx(37.0)
    for k, angle in enumerate(T1_ANGLES_DEG):
        for inside in (0.0, 2.0, 3.999):
            point = plan.at(k * 5.5 + inside)
            assert point.value == pytest.approx(angle, abs=1e-9)
            assert abs(point.rate) + abs(point.acceleration) < 1e-9


def test_t1_is_at_rest_to_the_third_derivative_where_moves_begin_and_end():
    for knot in PLANS["t1"].knots[1:-1]:
        for side in (-1e-9, 1e-9):
            assert np.abs(PLANS["t1"].at(knot + side).tolist()[1:]) == pytest.approx([0, 0, 0], abs=1e-3)


def test_t2_spans_what_it_says_and_depends_on_its_seed():
    values = PLANS["t2"].sample(np.arange(0, 60, 0.002))[:, 0]
    assert (values.min(), values.max()) == pytest.approx(T2_SPAN_DEG, abs=0.01)
    assert t2(3).at(1.0) == PLANS["t2"].at(1.0)
    assert t2(4).at(1.0) != PLANS["t2"].at(1.0)
    assert PLANS["t2"].duration_s == 60.0


def test_the_excitations_stay_in_their_span_and_band():
    plan = excitation(0.5, 1)
    assert plan.table[:-1, 1].max() == pytest.approx(2 * np.pi * 0.5)
    values = plan.sample(np.arange(0, plan.duration_s, 0.01))[:, 0]
    assert values.min() > 4.9
    assert values.max() < 110.1


@given(*[st.floats(-100, 100)] * 5, st.floats(0.5, 10))
def test_the_smooth_move_meets_both_ends(start, value, rate, acceleration, jerk, seconds):
    end = np.array([value, rate, acceleration, jerk])
    solved = smooth_move(np.array([start, 0, 0, 0]), end, seconds)
    closed = np.zeros(8)
    point = references.new_record(references.REFERENCE)
    point.value, point.rate, point.acceleration, point.jerk = end
    move_between(start, point, seconds, closed)
    scale = seconds ** np.arange(8)
    assert closed * scale == pytest.approx(solved * scale, rel=1e-6, abs=1e-6)
    references.polynomial_at(closed, seconds, point)
    assert [point.value, point.rate] == pytest.approx([value, rate], rel=1e-6, abs=1e-5)


def test_a_csv_becomes_a_smooth_plan(tmp_path):
    times = np.arange(0, 20, 0.05)
    file = tmp_path / "r.csv"
    np.savetxt(file, np.c_[times, 60 + 10 * np.sin(times)], delimiter=",", header="t_s,angle_deg")
    plan = from_csv(file)
    point = plan.at(3.3)
    assert point.value == pytest.approx(60 + 10 * np.sin(3.3), abs=1e-6)
    assert point.jerk == pytest.approx(-10 * np.cos(3.3), abs=1e-3)


@pytest.mark.parametrize("text", ["", "t,v\n0,1\n", "t,v\n" + "0,1\n" * 9, "t,v\n" + "\n".join(f"{k},x" for k in range(9))])
def test_bad_csv_files_are_one_line(tmp_path, text):
    file = tmp_path / "bad.csv"
    file.write_text(text)
    with pytest.raises(BadFile, match=r"bad\.csv"):
        from_csv(file)


def test_trajectories_that_do_not_fit_the_law_are_refused():
    with pytest.raises(BadConfig, match="needs law"):
        plan_of(ControllerConfig(law="arc", trajectory="excitation_1hz"))
    with pytest.raises(BadConfig, match="is an angle"):
        plan_of(ControllerConfig(law="pressure", trajectory="t1"))
    for law, trajectory in (("valve_test", "t1"), ("arc", "valve_steps")):
        with pytest.raises(BadConfig, match="go together"):
            plan_of(ControllerConfig(law=law, trajectory=trajectory))
    with pytest.raises(BadConfig, match="no such file, and not one of t1, t2"):
        plan_of(ControllerConfig(trajectory="t3"))


@pytest.mark.parametrize(
    ("low", "high", "hz", "word"),
    [
        (15.0, 60.0, 0.2, "without pressure the actuator rests at 26.7"),
        (50.0, 130.0, 2.5, "kPa"),
        (100.0, 320.0, 0.1, "the supply of"),
    ],
)
def test_an_infeasible_reference_says_where_and_why(tmp_path, low, high, hz, word):
    plan = multi_sine((hz,), (low, high), 20.0, 1)
    times = np.arange(0, 20, 0.02)
    file = tmp_path / "r.csv"
    np.savetxt(file, np.c_[times, plan.sample(times)[:, 0]], delimiter=",", header="t_s,angle_deg")
    with pytest.raises(BadConfig, match="not feasible") as caught:
        build(ControllerConfig(trajectory=str(file)))
    assert word in str(caught.value)


def test_flow_tests_charge_and_exhaust_at_each_current_from_rest():
    plan = valve_steps(np.array([80.0, 120.0]), 3.0, 2.0, 4.0, 0.5)
    assert plan.duration_s == 2 * (3.0 + 2.0 + 3.0 + 4.0 + 4 * 0.5)
    middles = 0.5 * (plan.knots[:-1] + plan.knots[1:])
    currents = [float(plan.at(t).value) for t in middles]
    assert currents[::2] == [0.0] * 8
    assert currents[1::2] == [80.0, 120.0, -80.0, -120.0, 120.0, 120.0, -120.0, -120.0]


@pytest.mark.parametrize(
    ("given", "word"),
    [
        ({"first_ma": 100.0, "last_ma": 90.0}, "first_ma must be below last_ma"),
        ({"last_ma": 500.0}, "at most the valves' 220 mA"),
    ],
)
def test_currents_that_no_valve_can_have_are_refused(given, word):
    with pytest.raises(BadConfig, match=word):
        build(ControllerConfig.model_validate({"law": "valve_test", "trajectory": "valve_steps", "valve_test": given}))
