"""The safety gate as a function of what it is given."""

import os
import subprocess
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softloop.devices import gate as g
from softloop.devices.config import PERIOD_NS
from tests.devices import test_wt931 as line
from tests.devices.gate_bench import INCLINATION_DELAY_NS, PRESSURE_DELAY_NS, GateBench, word

MS = 1_000_000
NAN, INF = float("nan"), float("inf")


def test_it_starts_disarmed_and_vents():
    bench = GateBench()
    output = bench.tick(command=False, heard=False)
    assert word(output) == (g.GATE_DISARMED, g.OUTPUT_VENT, g.REASON_NONE)
    assert (output.charge_current_ma, output.exhaust_current_ma) == (0.0, 200.0)


def test_it_passes_currents_once_armed_and_not_before():
    bench = GateBench()
    assert bench.tick().charge_counts == 0
    output = bench.arm()
    assert word(output) == (g.GATE_ARMED, g.OUTPUT_PASS, g.REASON_NONE)
    assert output.changed == 1
    assert (output.charge_counts, output.exhaust_counts) == (10_000, 5_000)


FAULTS = [
    (g.REASON_NOT_FINITE, {"charge_current_ma": NAN}),
    (g.REASON_NOT_FINITE, {"exhaust_current_ma": INF}),
    (g.REASON_NOT_FINITE, {"angle_deg": NAN}),
    (g.REASON_NOT_FINITE, {"chamber_pressure_kpa": -INF}),
    (g.REASON_NOT_READY, {"ready": 0}),
    (g.REASON_NOT_READY, {"ready": 0, "angle_deg": NAN}),
    (g.REASON_SENSOR_LOST, {"pressure_stamp_ns": 0}),
    (g.REASON_SENSOR_LOST, {"inclination_stamp_ns": 0}),
    (g.REASON_SENSOR_STALE, {"pressure_stamp_ns": 1}),
    (g.REASON_SENSOR_STALE, {"inclination_stamp_ns": 1}),
    (g.REASON_SENSOR_STALE, {"inclination_stamp_ns": 2**62}),
    (g.REASON_OVER_PRESSURE, {"chamber_pressure_kpa": 190.1}),
    (g.REASON_OVER_ANGLE, {"angle_deg": 200.1}),
    (g.REASON_OVER_ANGLE, {"angle_deg": -20.1}),
    (g.REASON_OUT_OF_RANGE, {"charge_current_ma": 220.01}),
    (g.REASON_OUT_OF_RANGE, {"exhaust_current_ma": -0.01}),
    (g.REASON_CONTROLLER_LOST, {"command_seq": 1}),
    (g.REASON_BUS_OFF, {"bus_off": 1}),
    (g.REASON_DRIVER_SILENT, {"driver": g.DRIVER_WATCHDOG}),
    (g.REASON_EMERGENCY_STOP, {"stop": g.STOP_ASKED}),
    (g.REASON_EMERGENCY_STOP, {"stop": g.STOP_ASKED | g.STOP_INVARIANT}),
    (g.REASON_INVARIANT, {"stop": g.STOP_INVARIANT}),
]


@pytest.mark.parametrize(("reason", "fields"), FAULTS)
def test_every_fault_vents_at_once_and_stays(reason, fields):
    bench = GateBench().armed()
    output = bench.tick(**fields)
    assert word(output) == (g.GATE_FAULT, g.OUTPUT_VENT, reason)
    assert (output.changed, output.charge_counts, output.exhaust_counts) == (1, 0, 20_000)
    for _ in range(50):
        output = bench.tick()
        assert (output.gate, output.reason, output.changed, output.charge_counts) == (g.GATE_FAULT, reason, 0, 0)


@pytest.mark.parametrize(("reason", "fields"), FAULTS)
@pytest.mark.parametrize("first", [{}, {"stop": 1}])
def test_no_arming_while_a_fault_condition_holds(reason, fields, first):
    bench = GateBench()
    bench.tick(**first)
    before = int(bench.state.gate)
    output = bench.arm(**fields)
    assert output.refused == reason
    assert output.gate == (g.GATE_FAULT if "stop" in fields else before)
    assert bench.tick().charge_counts == 0, "a refused request is used up"
    assert bench.arm().gate == g.GATE_ARMED


def test_a_command_that_was_overtaken_is_no_command():
    bench = GateBench().armed()
    for _ in range(3):
        output = bench.tick(command_seq=bench.seq - 5, charge_current_ma=NAN)
        assert (output.gate, output.charge_counts) == (g.GATE_ARMED, 10_000)
    assert bench.tick(command_seq=bench.seq - 5).reason == g.REASON_COMMAND_SILENT


def test_the_limits_themselves_are_allowed():
    bench = GateBench().armed()
    edge = {"chamber_pressure_kpa": 190.0, "angle_deg": 200.0, "charge_current_ma": 220.0, "exhaust_current_ma": 0.0}
    edge["pressure_stamp_ns"] = bench.now_ns + PERIOD_NS - bench.process.pressure_age_ns
    edge["inclination_stamp_ns"] = bench.now_ns + PERIOD_NS - bench.process.inclination_age_ns
    assert bench.tick(**edge).charge_counts == 22_000
    assert bench.tick(pressure_stamp_ns=bench.now_ns + PERIOD_NS - bench.process.pressure_age_ns - 1).gate == g.GATE_FAULT


@pytest.mark.parametrize("command_first", [True, False])
def test_without_a_command_there_is_no_arming(command_first):
    bench = GateBench()
    bench.tick(command=command_first)
    for _ in range(5):
        bench.tick(command=False)
    reason = g.REASON_COMMAND_SILENT if command_first else g.REASON_CONTROLLER_LOST
    assert bench.arm(command=False).refused == reason


@pytest.mark.parametrize("hold", [0, 3, 5])
def test_a_silent_controller_is_held_for_its_ticks_and_then_vented(hold):
    bench = GateBench(hold_ticks=hold).armed()
    for _ in range(hold):
        assert word(bench.tick(command=False)) == (g.GATE_ARMED, g.OUTPUT_PASS, g.REASON_NONE)
        assert (bench.output.charge_counts, bench.output.exhaust_counts) == (10_000, 5_000)
    assert word(bench.tick(command=False)) == (g.GATE_FAULT, g.OUTPUT_VENT, g.REASON_COMMAND_SILENT)


def test_wakes_at_wall_pace_hold_as_many_ticks():
    bench = GateBench().armed()
    outputs = [int(bench.tick(command=False, after_ns=wait).output) for wait in (6_500_000, PERIOD_NS, PERIOD_NS, PERIOD_NS)]
    assert outputs == [g.OUTPUT_PASS] * 3 + [g.OUTPUT_VENT]


def test_a_stalled_gate_does_not_hold_longer():
    bench = GateBench().armed()
    assert bench.tick(command=False, after_ns=20 * MS).reason == g.REASON_COMMAND_SILENT


def test_a_silent_driver_is_a_fault_after_its_budget():
    bench = GateBench().armed()
    ticks = int(bench.config["driver_silence_ns"]) // PERIOD_NS
    assert ticks == 10
    outputs = [int(bench.tick(heard=False).gate) for _ in range(ticks + 1)]
    assert outputs == [g.GATE_ARMED] * ticks + [g.GATE_FAULT]
    assert (bench.output.reason, bench.output.driver) == (g.REASON_DRIVER_SILENT, g.DRIVER_SILENT)


@pytest.mark.parametrize("sensor", ["pressure", "inclination"])
@pytest.mark.parametrize("phase_ns", range(0, PERIOD_NS, 700_000))
def test_a_dead_sensor_vents_within_its_budget(sensor, phase_ns):
    bench = GateBench().armed()
    budget_ns = getattr(bench.process, f"{sensor}_age_ns")
    delay_ns = {"pressure": PRESSURE_DELAY_NS, "inclination": INCLINATION_DELAY_NS}[sensor]
    last_stamp_ns = bench.now_ns + PERIOD_NS - delay_ns - phase_ns
    while bench.tick(**{f"{sensor}_stamp_ns": last_stamp_ns}).gate == g.GATE_ARMED:
        assert bench.now_ns - last_stamp_ns <= budget_ns
    assert word(bench.output) == (g.GATE_FAULT, g.OUTPUT_VENT, g.REASON_SENSOR_STALE)
    assert bench.now_ns - last_stamp_ns <= budget_ns + PERIOD_NS, "no later than the first tick past the budget"


def test_a_held_arm_request_does_not_arm_again():
    bench = GateBench().armed()
    bench.tick(stop=1)
    for _ in range(20):
        assert bench.request(77, bench.arms).gate == g.GATE_FAULT
    assert bench.arm().gate == g.GATE_ARMED


def test_two_who_hold_their_requests_do_not_arm_again_between_them():
    bench = GateBench().armed()
    assert bench.request(5, 1).gate == g.GATE_ARMED
    bench.tick(stop=1)
    for _ in range(10):
        assert bench.request(77, bench.arms).gate == g.GATE_FAULT
        assert bench.request(5, 1).gate == g.GATE_FAULT


def test_stop_beats_disarm_beats_arm():
    bench = GateBench().armed()
    assert bench.arm(disarm=1).gate == g.GATE_DISARMED
    assert bench.output.reason == g.REASON_REQUEST
    assert bench.arm(disarm=1).refused == g.REASON_REQUEST
    assert bench.arm(disarm=1, stop=1).gate == g.GATE_FAULT


def test_disarming_does_not_clear_a_fault():
    bench = GateBench().armed()
    bench.tick(stop=1)
    assert word(bench.tick(disarm=1)) == (g.GATE_FAULT, g.OUTPUT_VENT, g.REASON_EMERGENCY_STOP)


def test_shutting_down_vents():
    assert word(GateBench().armed().tick(shutdown=1)) == (g.GATE_DISARMED, g.OUTPUT_VENT, g.REASON_SHUTDOWN)


def test_venting_ends_when_the_chamber_is_empty_and_begins_again():
    bench = GateBench()
    assert bench.tick(chamber_pressure_kpa=2.1).output == g.OUTPUT_VENT
    assert bench.tick(chamber_pressure_kpa=2.0).output == g.OUTPUT_CLOSED
    assert (bench.output.charge_counts, bench.output.exhaust_counts) == (0, 0)
    assert bench.tick(chamber_pressure_kpa=10.0).output == g.OUTPUT_CLOSED
    assert bench.tick(chamber_pressure_kpa=10.1).output == g.OUTPUT_VENT
    assert bench.tick(chamber_pressure_kpa=10.0).output == g.OUTPUT_VENT


def test_venting_ends_by_time_when_nothing_is_known_of_the_pressure():
    bench = GateBench(vent_time_s=1.0)
    outputs = [int(bench.tick(command=False).output) for _ in range(202)]
    assert outputs == [g.OUTPUT_VENT] * 200 + [g.OUTPUT_CLOSED] * 2


def test_venting_goes_on_past_its_time_while_pressure_is_seen():
    bench = GateBench(vent_time_s=1.0)
    assert {int(bench.tick(chamber_pressure_kpa=11.0).output) for _ in range(300)} == {g.OUTPUT_VENT}
    assert bench.tick(chamber_pressure_kpa=9.0).output == g.OUTPUT_CLOSED


def test_venting_ends_only_when_the_chamber_has_stayed_empty():
    bench = GateBench(vent_settle_s=0.1)
    empty = [int(bench.tick(chamber_pressure_kpa=1.0).output) for _ in range(19)]
    assert bench.tick(chamber_pressure_kpa=3.0).output == g.OUTPUT_VENT  # gas that expanded cold has warmed up
    again = [int(bench.tick(chamber_pressure_kpa=1.0).output) for _ in range(22)]
    assert empty == [g.OUTPUT_VENT] * 19
    assert again == [g.OUTPUT_VENT] * 20 + [g.OUTPUT_CLOSED] * 2


def test_a_fault_vents_anew():
    bench = GateBench(vent_time_s=1.0)
    bench.tick(chamber_pressure_kpa=0.0)
    bench.arm(chamber_pressure_kpa=5.0)
    assert bench.tick(stop=1, chamber_pressure_kpa=5.0).output == g.OUTPUT_VENT


def test_currents_change_no_faster_than_allowed_and_vents_at_once():
    bench = GateBench(slew_ma_per_tick=30.0, overlap_ma=220.0)
    bench.tick(chamber_pressure_kpa=0.0)
    asked = {"charge_current_ma": 100.0, "exhaust_current_ma": 0.0}
    sent = [float(bench.arm(**asked).charge_current_ma)] + [float(bench.tick(**asked).charge_current_ma) for _ in range(4)]
    assert sent == pytest.approx([30, 60, 90, 100, 100])
    assert bench.tick(charge_current_ma=0.0).charge_current_ma == 70.0
    assert bench.tick(stop=1).charge_counts == 0
    assert bench.output.exhaust_counts == 20_000


def test_both_valves_are_never_wide_open():
    bench = GateBench().armed()
    output = bench.tick(charge_current_ma=150.0, exhaust_current_ma=150.0)
    assert (output.charge_current_ma, output.exhaust_current_ma) == (70.0, 150.0)


# --- any sequence of events ---------------------------------------------------------------------------------------------------

BAD = st.sampled_from([fields for _, fields in FAULTS])
STEP = st.fixed_dictionaries(
    {},
    optional={
        "command": st.booleans(),
        "heard": st.booleans(),
        "after_ns": st.sampled_from([0, MS, PERIOD_NS, 6_500_000, 30 * MS]),
        "charge_current_ma": st.floats(0, 220),
        "exhaust_current_ma": st.floats(0, 220),
        "chamber_pressure_kpa": st.floats(-2, 40),
        "disarm": st.just(1),
        "shutdown": st.just(1),
    },
)
ARM = st.sampled_from(["no", "no", "no", "held", "new"])
EVENTS = st.lists(st.tuples(STEP, st.just({}) | BAD, ARM), max_size=60)


def judge_step(bench, before, arm, output):
    """What must hold of every step, whatever came."""
    gate, charge, exhaust = int(output.gate), float(output.charge_current_ma), float(output.exhaust_current_ma)
    if gate == g.GATE_ARMED:
        assert before["gate"] == g.GATE_ARMED or arm == "new", "armed only by a request not made before"
        assert g.condition(bench.config, bench.state, bench.given) == g.REASON_NONE
        assert output.output == g.OUTPUT_PASS
        for now, last in ((charge, before["charge_ma"]), (exhaust, before["exhaust_ma"])):
            assert now <= 220.0
            assert now - last <= 30.0 + 0.011
        assert min(charge, exhaust) <= 70.0 + 0.005
    else:
        assert charge == 0.0
        assert exhaust == (200.0 if output.output == g.OUTPUT_VENT else 0.0)
        assert output.output != g.OUTPUT_PASS
    if before["gate"] == g.GATE_FAULT:
        assert gate != g.GATE_DISARMED
    if gate != before["gate"]:
        assert output.changed == 1
        assert (output.reason != g.REASON_NONE) == (gate != g.GATE_ARMED)
    if gate == g.GATE_FAULT:
        assert output.reason != g.REASON_NONE
    assert (output.refused != g.REASON_NONE) <= (arm == "new")


@given(EVENTS)
@settings(max_examples=300)
def test_no_sequence_of_events_passes_current_that_it_must_not(events):
    bench = GateBench(slew_ma_per_tick=30.0)
    bench.tick()
    bench.arm()
    for step, bad, arm in events:
        before = {name: bench.state[name].item() for name in ("gate", "charge_ma", "exhaust_ma")}
        fields = step | bad
        if arm == "held":
            fields |= {"arm": 1, "arm_origin": 77, "arm_seq": bench.arms, "arm_stamp_ns": bench.now_ns}
        judge_step(bench, before, arm, bench.arm(**fields) if arm == "new" else bench.tick(**fields))


SCRIPT = """
import random
from tests.devices.gate_bench import GateBench
from tests.devices.test_gate import FAULTS
rng, bench = random.Random(4), GateBench(slew_ma_per_tick=30.0)
for _ in range(1000):
    fields = {"charge_current_ma": rng.uniform(0, 220), "exhaust_current_ma": rng.uniform(0, 90)}
    fields |= rng.choice(FAULTS)[1] if rng.random() < 0.02 else {}
    output = (bench.arm if rng.random() < 0.1 else bench.tick)(command=rng.random() < 0.9, **fields)
    print(output.tobytes().hex(), bench.state.tobytes().hex())
"""


def test_compiled_and_plain_python_are_the_same_to_the_bit():
    def run(**more):
        environment = os.environ | more
        return subprocess.run(
            [sys.executable, "-c", SCRIPT], env=environment, capture_output=True, check=True, timeout=120
        ).stdout

    compiled = run()
    assert compiled.count(b"\n") == 1000
    assert compiled == run(NUMBA_DISABLE_JIT="1")


TEN_MINUTES = 120_000  # ticks


def test_ten_minutes_of_lost_serial_bytes_are_no_fault():
    """Each tick answers the newest sample that came through a line that loses one byte in a thousand."""
    samples = dict(line.replay(TEN_MINUTES, 0.001, 2)[0])
    bench = GateBench()
    bench.now_ns = 0
    newest, reasons = 0, set()
    for k in range(10, TEN_MINUTES):
        newest = samples[k].stamp_ns if k in samples else newest
        at_ns = k * PERIOD_NS + PERIOD_NS - 1  # the controller's tick just before the next burst is complete: the worst phase
        answer = {"inclination_stamp_ns": newest, "after_ns": at_ns - bench.now_ns}
        output = bench.arm(**answer) if k == 20 else bench.tick(**answer)
        reasons.add((int(output.gate), int(output.reason)) if k >= 20 else None)
    assert reasons == {None, (g.GATE_ARMED, g.REASON_NONE)}
