"""The gate at its edges: limits met exactly, the first instants of a clock, numbers of commands and of who asks to arm."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.devices import gate as g
from softloop.devices.config import PERIOD_NS
from tests.devices.gate_bench import GateBench, word

MS = 1_000_000
NAN = float("nan")


def test_the_other_limits_themselves_are_allowed():
    output = GateBench().armed().tick(angle_deg=-20.0, charge_current_ma=0.0, exhaust_current_ma=220.0)
    assert (word(output), output.exhaust_counts) == ((g.GATE_ARMED, g.OUTPUT_PASS, g.REASON_NONE), 22_000)
    assert GateBench().armed().tick(exhaust_current_ma=220.01).reason == g.REASON_OUT_OF_RANGE


@pytest.mark.parametrize("behind", [0, 1, 39])
def test_a_command_that_is_not_newer_says_nothing(behind):
    bench = GateBench().armed()
    assert bench.tick(command_seq=bench.seq - behind, charge_current_ma=NAN).gate == g.GATE_ARMED


def test_a_command_farther_behind_is_another_controllers():
    bench = GateBench().armed()
    assert bench.tick(command_seq=bench.seq - 40).reason == g.REASON_CONTROLLER_LOST


def test_a_first_command_without_a_number_does_not_arm_but_its_pressure_counts():
    bench = GateBench()
    assert bench.tick(command_seq=0, chamber_pressure_kpa=0.0).output == g.OUTPUT_CLOSED
    assert bench.arm(command_seq=0).refused == g.REASON_CONTROLLER_LOST
    assert bench.arm(command_seq=1).gate == g.GATE_ARMED


def test_in_the_first_instant_of_the_clock_all_that_was_heard_counts():
    bench = GateBench()
    bench.now_ns = 0
    output = bench.tick(after_ns=1, pressure_stamp_ns=1, inclination_stamp_ns=1, chamber_pressure_kpa=0.0)
    assert (output.output, output.driver) == (g.OUTPUT_CLOSED, g.DRIVER_OK)
    again = {"command_seq": bench.seq, "charge_current_ma": NAN}  # the same command once more says nothing
    assert bench.arm(heard=False, after_ns=1, **again).gate == g.GATE_ARMED


def test_near_the_beginning_of_the_clock_what_was_never_heard_does_not_count():
    bench = GateBench()
    bench.now_ns = 0
    output = bench.tick(command=False, heard=False)
    assert (output.output, output.driver) == (g.OUTPUT_VENT, g.DRIVER_SILENT)


@pytest.mark.parametrize(("stamp_ns", "output"), [(0, g.OUTPUT_CLOSED), (1, g.OUTPUT_VENT), (2**62, g.OUTPUT_VENT)])
def test_a_pressure_ends_the_venting_up_to_this_very_moment(stamp_ns, output):
    """`stamp_ns` is after the gate's step."""
    bench = GateBench()
    now_ns = bench.now_ns + PERIOD_NS
    assert bench.tick(pressure_stamp_ns=now_ns + stamp_ns, chamber_pressure_kpa=0.0).output == output


@pytest.mark.parametrize(("older_ns", "output"), [(0, g.OUTPUT_CLOSED), (1, g.OUTPUT_VENT)])
def test_a_pressure_ends_the_venting_while_it_is_fresh(older_ns, output):
    bench = GateBench()
    stamp_ns = bench.now_ns + PERIOD_NS - bench.process.pressure_age_ns - older_ns
    assert bench.tick(pressure_stamp_ns=stamp_ns, chamber_pressure_kpa=0.0).output == output


@pytest.mark.parametrize("bad", [{"pressure_stamp_ns": 0}, {"chamber_pressure_kpa": NAN}])
def test_a_pressure_that_is_none_leaves_the_last_one_standing(bad):
    bench = GateBench(vent_settle_s=0.02)
    empty = {"chamber_pressure_kpa": 0.0}
    outputs = [int(bench.tick(**(empty | more)).output) for more in ({}, {}, bad, {}, {})]
    assert outputs == [g.OUTPUT_VENT] * 4 + [g.OUTPUT_CLOSED]


@pytest.mark.parametrize("end", [{"stop": 1}, {"disarm": 1}, {"shutdown": 1}])
def test_what_ends_a_long_arming_vents_for_its_whole_time(end):
    """The pressure that is left is between the one that ends venting and the one that keeps it up."""
    bench = GateBench(vent_time_s=1.0).armed()
    for _ in range(300):
        assert bench.tick().gate == g.GATE_ARMED
    left = {"chamber_pressure_kpa": 5.0}
    outputs = [int(bench.tick(**end, **left).output)] + [int(bench.tick(**left).output) for _ in range(201)]
    assert outputs == [g.OUTPUT_VENT] * 200 + [g.OUTPUT_CLOSED] * 2


def test_a_pressure_heard_long_ago_does_not_keep_the_venting_up():
    bench = GateBench(vent_time_s=1.0)
    outputs = [int(bench.tick(chamber_pressure_kpa=50.0).output)] + [int(bench.tick(command=False).output) for _ in range(201)]
    assert outputs == [g.OUTPUT_VENT] * 200 + [g.OUTPUT_CLOSED] * 2


def request(bench, origin, seq, **fields):
    return bench.request(origin, seq, **fields)


@pytest.mark.parametrize("origin", [0, 77])
def test_a_first_request_arms_whatever_its_number(origin):
    bench = GateBench()
    bench.tick()
    assert request(bench, origin, 0).gate == g.GATE_ARMED


def test_an_older_request_does_not_make_a_used_one_new():
    bench = GateBench().armed()
    assert request(bench, 5, 9).gate == g.GATE_ARMED
    bench.tick(stop=1)
    for seq in (9, 3, 9):
        assert request(bench, 5, seq).gate == g.GATE_FAULT
    assert request(bench, 5, 10).gate == g.GATE_ARMED


def test_eight_who_asked_are_remembered_and_a_ninth_is_taken_when_one_may_be_forgotten():
    bench = GateBench()
    bench.tick()
    for origin in range(8):
        bench.tick(stop=1)
        assert request(bench, origin, 1).gate == g.GATE_ARMED
    bench.tick(stop=1)
    first_ns = bench.now_ns - 15 * PERIOD_NS
    for origin in range(1, 8):
        assert request(bench, origin, 1).gate == g.GATE_FAULT
    assert request(bench, 8, 1).gate == g.GATE_FAULT, "all eight were heard within the last second"
    assert bench.state.requesters == 8
    bench.tick(after_ns=first_ns + g.ARM_AGE_NS - bench.now_ns - PERIOD_NS)
    assert request(bench, 8, 2).gate == g.GATE_FAULT, "the one heard first was heard a second ago"
    assert request(bench, 8, 3).gate == g.GATE_ARMED
    bench.tick(stop=1)
    for origin in range(1, 8):
        assert request(bench, origin, 1).gate == g.GATE_FAULT, "each but the one heard first is still remembered"


@given(st.lists(st.tuples(st.integers(0, 2**63 - 1), st.sampled_from([PERIOD_NS, 100 * MS, 400 * MS])), max_size=30))
def test_a_request_played_again_never_arms_however_many_others_asked_between(others):
    bench = GateBench().armed()
    first = dict(bench.asked)
    bench.tick(stop=1)
    for origin, after_ns in others:
        request(bench, origin, 2**62, driver=g.DRIVER_WATCHDOG, after_ns=after_ns)  # refused, but heard
        assert bench.tick(**first).gate == g.GATE_FAULT


@pytest.mark.parametrize(
    ("age_ns", "arms"), [(0, True), (g.ARM_AGE_NS, True), (g.ARM_AGE_NS + 1, False), (-1, False), (2**62, False)]
)
def test_an_arm_request_that_answers_an_old_word_or_none_of_this_clock_does_not_arm(age_ns, arms):
    bench = GateBench()
    bench.tick()
    output = request(bench, 5, 1, arm_stamp_ns=bench.now_ns + PERIOD_NS - age_ns)
    assert bool(output.gate == g.GATE_ARMED) is arms
    assert output.refused == (g.REASON_NONE if arms else g.REASON_OLD_REQUEST)
    assert request(bench, 5, 2).gate == g.GATE_ARMED


def test_no_request_is_refused_where_none_came():
    bench = GateBench()
    assert [int(bench.tick(arm_stamp_ns=stamp_ns).refused) for stamp_ns in (0, 1, bench.now_ns)] == [g.REASON_NONE] * 3


def test_late_requests_are_not_remembered_for_they_take_the_place_of_others():
    bench = GateBench()
    bench.tick()
    for origin in range(8):
        assert request(bench, origin, 1, arm_stamp_ns=1).refused == g.REASON_OLD_REQUEST
    assert request(bench, 8, 1).gate == g.GATE_ARMED


def test_of_eight_the_one_not_heard_for_longest_is_forgotten_wherever_it_stands():
    bench = GateBench()
    bench.tick()
    for origin in range(8):
        request(bench, origin, 1, stop=1)
    for origin in (0, 1, 2, 4, 5, 6, 7):
        request(bench, origin, 2, stop=1, after_ns=200 * MS)
    assert request(bench, 8, 1).gate == g.GATE_ARMED, "the fourth was heard more than a second ago, the first was not"
    assert 3 not in bench.state.arm_origin


def test_a_requester_of_number_0_is_one_as_any_other():
    bench = GateBench()
    bench.tick()
    assert request(bench, 77, 1, stop=1).gate == g.GATE_FAULT
    assert request(bench, 0, 0).gate == g.GATE_ARMED


def test_the_config_is_the_bench_files_numbers_to_the_nanosecond():
    config = GateBench(driver_silence_ms=37.0, vent_settle_s=0.75, vent_time_s=3.0, hold_ticks=2).config
    assert (config.driver_silence_ns, config.vent_settle_ns, config.vent_time_ns) == (37 * MS, 750 * MS, 3000 * MS)
    assert config.silence_ns == 3 * PERIOD_NS


def test_a_stop_is_no_less_for_a_late_arm_request():
    bench = GateBench().armed()
    assert request(bench, 5, 1, arm_stamp_ns=1).gate == g.GATE_ARMED, "nor does one disarm"
    output = request(bench, 5, 2, arm_stamp_ns=1, stop=g.STOP_ASKED)
    assert (output.gate, output.reason, output.refused) == (g.GATE_FAULT, g.REASON_EMERGENCY_STOP, g.REASON_EMERGENCY_STOP)


def test_a_stop_gives_a_fault_its_reason_anew_and_that_is_a_change():
    bench = GateBench().armed()
    bench.tick(angle_deg=201.0)
    output = bench.tick(stop=g.STOP_ASKED)
    assert (*word(output), output.changed) == (g.GATE_FAULT, g.OUTPUT_VENT, g.REASON_EMERGENCY_STOP, 1)
    assert bench.tick(stop=g.STOP_ASKED).changed == 0


def test_steps_are_counted():
    bench = GateBench()
    for _ in range(3):
        bench.tick()
    assert bench.state.steps == 3


@pytest.mark.parametrize(
    ("charge", "exhaust", "passed"), [(100.0, 70.0, 100.0), (100.0, 70.01, 70.0), (30.0, 150.0, 30.0), (80.0, 0.0, 80.0)]
)
def test_the_charge_current_is_held_only_while_the_exhaust_is_above_the_overlap(charge, exhaust, passed):
    output = GateBench().armed().tick(charge_current_ma=charge, exhaust_current_ma=exhaust)
    assert (output.charge_current_ma, output.exhaust_current_ma) == (passed, exhaust)


@pytest.mark.parametrize(
    ("asked", "sent", "passed"),
    [
        (50.0, 50.0, 50.0),
        (90.0, 50.0, 80.0),
        (10.0, 50.0, 20.0),
        (0.0, 10.0, 0.0),
        (-5.0, 10.0, 0.0),
        (300.0, 210.0, 220.0),
        (0.5, 0.0, 0.5),
    ],
)
def test_a_current_is_within_its_range_and_within_a_steps_change(asked, sent, passed):
    assert g.limited(asked, sent, 30.0, 220.0) == passed
