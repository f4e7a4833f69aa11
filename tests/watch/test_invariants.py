from collections import namedtuple
from dataclasses import replace
from math import exp, inf, nan

import pytest

from softloop.watch.invariants import (
    BOUND,
    CHATTER,
    COMMAND,
    ERROR,
    PARAMETERS,
    PERIOD_S,
    Limits,
    Memory,
    detection_ticks,
    judge,
    settling_ticks,
    ultimate_v2,
)
from softloop.wire.messages import constant

CHARGE, EXHAUST, HOLD = (constant("ValveCommand", f"MODE_{n}") for n in ("CHARGE", "EXHAUST", "HOLD"))
WAIT, APPROACH, TRACK, DONE = (constant("CycleRecord", f"PHASE_{n}") for n in ("WAIT", "APPROACH", "TRACK", "DONE"))
LIMITS = Limits(
    theta=((0.0, 1.0), (-3.0, -2.0)), current_max_ma=220.0, error_max_deg=10.0, error_ticks=4, switches_max=5, v2_max=100.0,
    rho=10.0, settled_ticks=3, desired_max_kpa=150.0,
)  # fmt: skip
GOOD = {
    "tick": 0, "phase": TRACK, "mode": CHARGE, "theta": (0.5, -2.5), "charge_current_ma": 100.0, "exhaust_current_ma": 0.0,
    "error_deg": 0.1, "s1_deg_s": 1.0, "s2_kpa": 0.5, "desired_pressure_kpa": 60.0, "saturated": 0, "inputs_valid": 1,
}  # fmt: skip
Cycle = namedtuple("Cycle", GOOD)


def judged(*changes, limits=LIMITS):
    """The verdicts on a run of records, each the good one with some changes, by tick."""
    memory, found = Memory(), []
    for tick, change in enumerate(changes):
        memory, verdicts = judge(limits, memory, Cycle(**GOOD | {"tick": tick} | change))
        found.append({verdict.invariant: verdict.value for verdict in verdicts})
    return found


def test_a_good_run_has_no_verdict():
    assert judged(*[{}] * 300) == [{}] * 300


@pytest.mark.parametrize(("theta", "place"), [((1.01, -2.5), 0), ((0.5, -1.99), 1), ((0.5, nan), 1), ((-inf, -2.5), 0)])
def test_an_estimate_outside_its_set_is_seen_at_once_and_named(theta, place):
    assert judged({}, {"theta": theta})[1] == {PARAMETERS: place}


def test_an_estimate_on_its_bound_is_inside():
    assert judged({"theta": (1.0, -3.0)}) == [{}]


@pytest.mark.parametrize("current", [220.1, -0.1, nan, inf])
@pytest.mark.parametrize("name", ["charge_current_ma", "exhaust_current_ma"])
def test_a_current_outside_saturation_is_seen_at_once(name, current):
    assert set(judged({}, {name: current})[1]) == {COMMAND}


def test_the_error_must_leave_its_envelope_for_some_ticks_on_the_trajectory():
    out = {"error_deg": -10.1}
    assert judged(out, out, out, {}, out, out, out) == [{}] * 7
    assert judged(out, out, out, out)[3] == {ERROR: -10.1}
    assert judged(*[{"error_deg": nan}] * 4)[3].keys() == {ERROR}
    assert judged(*[out | {"phase": APPROACH}] * 9) == [{}] * 9


def test_chattering_is_counted_over_one_second():
    turns = [{"mode": (CHARGE, EXHAUST)[k // 10 % 2]} for k in range(100)]
    found = judged(*turns)
    assert next(k for k, verdicts in enumerate(found) if verdicts) == 60  # the sixth switch
    slow = [{"mode": (CHARGE, EXHAUST)[k // 45 % 2]} for k in range(1000)]
    assert judged(*slow) == [{}] * 1000


def test_the_first_record_after_a_rest_is_no_switch():
    assert judged(*[{"phase": WAIT, "mode": HOLD} if k % 2 else {} for k in range(50)]) == [{}] * 50


def test_the_bound_is_asked_for_only_where_its_assumptions_have_held():
    large = {"s1_deg_s": 15.0}
    assert judged(large, large, large)[2].keys() == {BOUND}
    assert judged(large, large, large)[2][BOUND] == pytest.approx(0.5 * (225.0 + 10.0 * 0.25) / 100.0)
    for broken in (
        {"saturated": 1},
        {"mode": HOLD},
        {"desired_pressure_kpa": 150.0},
        {"desired_pressure_kpa": 0.0},
        {"inputs_valid": 0},
    ):
        assert judged(large, large, large | broken, large, large) == [{}] * 5
    assert BOUND not in judged(large, large, large | {"theta": (2.0, -2.5)}, large, large)[4]
    assert judged(*[{"s2_kpa": 4.5}] * 3)[2].keys() == {BOUND}
    assert judged(*[{"s2_kpa": 4.0}] * 3)[2] == {}


def test_sets_that_are_not_watched_still_serve_the_bound():
    limits, large = replace(LIMITS, watch_theta=False), {"s1_deg_s": 15.0}
    assert judged(*[large | {"theta": (2.0, -2.5)}] * 5, limits=limits) == [{}] * 5
    assert judged(*[large] * 3, limits=limits)[2].keys() == {BOUND}


def test_nothing_is_judged_while_the_rig_rests():
    bad = {"theta": (nan, nan), "charge_current_ma": nan, "error_deg": nan}
    assert judged(bad | {"phase": WAIT}, bad | {"phase": DONE}) == [{}, {}]


def test_eq_50_in_numbers():
    v2, decay = ultimate_v2(30.0, 50.0, 1.05e6)
    assert (v2, decay) == (17500.0, 60.0)
    ticks = settling_ticks(decay)
    assert exp(-decay * PERIOD_S * ticks) <= 0.01 < exp(-decay * PERIOD_S * (ticks - 1))


def test_times_are_stated_for_every_invariant():
    assert detection_ticks(LIMITS) == {PARAMETERS: 1, COMMAND: 1, ERROR: 4, CHATTER: 200, BOUND: 1}
    assert judged(*[{"theta": (9.0, 9.0), "charge_current_ma": nan, "error_deg": nan}] * 9, limits=Limits()) == [{}] * 9
