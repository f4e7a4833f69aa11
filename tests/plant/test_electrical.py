import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softloop.devices.protocols.quantise import counts_to_deg, counts_to_deg_s, counts_to_kpa
from softloop.devices.protocols.wire_time import can_frame_ns, serial_ns
from softloop.plant.electrical import DRIVER_OK, DRIVER_WATCHDOG, next_event_ns
from softloop.plant.records import (
    ANGLE,
    CHAMBER,
    EVENT_ANALOG_FRAME,
    EVENT_DRIVER,
    EVENT_DRIVER_FRAME,
    EVENT_INCLINOMETER,
    EVENT_LOAD,
    EVENT_TRUTH,
    QUEUE,
)
from tests.plant.rigs import FRAME_NS, MS, Rig, of_kind


def test_each_sender_keeps_its_period_and_its_time_on_the_wire():
    rig = Rig(seed=4)
    events = rig.until(1_000 * MS)
    electrical = rig.params.electrical
    own_ns = round(5 * MS * (1 + electrical.clock_error))
    for kind, period_ns, phase_ns, wire_ns in (
        (EVENT_DRIVER_FRAME, 5 * MS, electrical.echo_phase_ns, can_frame_ns(8, 500_000)),
        (EVENT_ANALOG_FRAME, 5 * MS, electrical.analog_phase_ns, can_frame_ns(8, 500_000)),
        (EVENT_INCLINOMETER, own_ns, electrical.inclinometer_phase_ns, serial_ns(22, 115_200)),
    ):
        sent = of_kind(events, kind)
        assert np.all(np.diff(sent["sample_ns"]) == period_ns)
        assert sent["sample_ns"][0] == phase_ns
        assert np.all(sent["end_ns"] - sent["sample_ns"] == wire_ns)
        assert len(sent) in (199, 200, 201)
    assert electrical.clock_error != 0.0
    assert np.array_equal(of_kind(events, EVENT_TRUTH)["sample_ns"], np.arange(201) * 5 * MS)


def test_events_come_in_the_order_of_time():
    events = Rig(seed=5).hold(90.0, 0.0, 0, 500 * MS)
    assert np.all(np.diff(events["sample_ns"]) >= 0)


def test_nothing_happens_before_next_event():
    rig = Rig()
    rig.until(1)
    for _ in range(100):
        due_ns = int(next_event_ns(rig.params, rig.state))
        assert len(rig.until(due_ns - 1)) == 0
        assert rig.until(due_ns)["sample_ns"][0] == due_ns


def plan(rig, commands):
    for end_ns, charge, exhaust in commands:
        rig.command(charge, exhaust, end_ns)


COMMANDS = [
    (n * 5 * MS + FRAME_NS + 137 * n, 85.0 + n % 7, 0.0) if n % 3 else (n * 5 * MS + FRAME_NS, 0.0, 90.0) for n in range(60)
]


@settings(max_examples=30)
@given(st.lists(st.integers(0, 310 * MS), max_size=40), st.integers(20, 64))
def test_when_the_caller_looks_changes_nothing(looks, room):
    """The same frames give the same bytes, however time is cut and however small the caller's array of events is."""
    one, other = Rig(seed=2), Rig(seed=2)
    for rig in (one, other):
        plan(rig, COMMANDS)
    one.until(310 * MS)
    for to_ns in sorted(looks):
        other.until(to_ns, room)
    other.until(310 * MS, room)
    assert one.events == other.events
    assert one.truths == other.truths
    assert one.state.x.tobytes() == other.state.x.tobytes()


def test_frames_that_come_in_time_take_effect_at_their_end():
    """Handed over all at once or each just before its end: the same bytes."""
    one, other = Rig(seed=2), Rig(seed=2)
    plan(one, COMMANDS)
    one.until(310 * MS)
    for command in COMMANDS:
        other.until(command[0] - 1)
        plan(other, [command])
    other.until(310 * MS)
    assert one.events == other.events


def test_a_late_frame_takes_effect_at_once_and_is_known_to_be_late():
    rig = Rig()
    rig.until(30 * MS)
    at_ns = int(rig.state.t_ns)
    rig.command(90.0, 0.0, 10 * MS)
    rig.until(40 * MS)
    assert rig.state.driver.command_end_ns == 10 * MS
    assert rig.state.driver.command_applied_ns == at_ns


def test_seeds_make_other_rigs():
    assert not np.array_equal(Rig(seed=1).until(100 * MS), Rig(seed=2).until(100 * MS))


def test_the_watchdog_vents_and_a_good_frame_ends_it():
    rig = Rig()
    first = rig.hold(100.0, 0.0, 0, 100 * MS)
    assert rig.state.driver.state == DRIVER_OK
    assert [e["raw"][0] for e in of_kind(first, EVENT_DRIVER)] == [DRIVER_OK]
    last_end_ns = 95 * MS + FRAME_NS
    tripped = of_kind(rig.until(300 * MS), EVENT_DRIVER)
    assert tripped["sample_ns"].tolist() == [last_end_ns + 20 * MS]
    assert tripped["raw"][0, 0] == DRIVER_WATCHDOG
    assert (rig.state.command_charge_ma, rig.state.command_exhaust_ma) == (0.0, 200.0)
    assert rig.state.truth.driver == DRIVER_WATCHDOG
    back = of_kind(rig.hold(0.0, 0.0, 300 * MS, 310 * MS), EVENT_DRIVER)
    assert back["raw"][:, 0].tolist() == [DRIVER_OK]
    assert rig.state.command_exhaust_ma == 0.0


def test_the_watchdogs_vent_empties_the_chamber():
    rig = Rig()
    rig.hold(110.0, 0.0, 0, 1_000 * MS)
    assert rig.state.x[CHAMBER] > 40.0
    rig.until(5_000 * MS)
    assert abs(rig.state.x[CHAMBER]) < 0.5


def test_the_status_frame_carries_coil_currents_state_and_sequence():
    rig = Rig(coil_noise_ma=0.0)
    events = of_kind(rig.hold(100.0, 30.0, 0, 100 * MS), EVENT_DRIVER_FRAME)
    assert events["raw"][-1, :3].tolist() == [10_000, 3_000, DRIVER_OK]
    assert abs(events["raw"][-1, 3] - rig.seq) <= 1
    lag = Rig(seed=1).params.air.coil_lag_s
    assert 0.0 < lag < 5e-3


def test_the_driver_never_gives_more_than_its_limit():
    rig = Rig()
    rig.hold(600.0, 500.0, 0, 10 * MS)
    assert (rig.state.command_charge_ma, rig.state.command_exhaust_ma) == (220.0, 220.0)


def test_delays_are_pure():
    """Every sample and every effect, later by exactly the delay."""
    prompt = Rig(seed=3)
    late = Rig(seed=3, command_delay_ms=7.0, measurement_delay_ms=11.0)
    for n in range(60):
        prompt.command(90.0, 0.0, n * 5 * MS + FRAME_NS + 7 * MS)
        late.command(90.0, 0.0, n * 5 * MS + FRAME_NS)
    a, b = prompt.until(300 * MS), late.until(300 * MS)
    # The watchdog starts on arrival in both, so that all else is equal too.
    assert np.array_equal(a["raw"], b["raw"])
    assert np.array_equal(a["sample_ns"], b["sample_ns"])
    wires = np.isin(b["kind"], (EVENT_DRIVER_FRAME, EVENT_ANALOG_FRAME, EVENT_INCLINOMETER))
    assert np.all((b["end_ns"] - a["end_ns"])[wires] == 11 * MS)


def test_a_full_queue_refuses_and_counts():
    rig = Rig(command_delay_ms=1000.0)
    taken = [rig.command(0.0, 0.0, n * MS) for n in range(QUEUE + 3)]
    assert taken == [True] * QUEUE + [False] * 3
    assert rig.state.driver.refused == 3


def test_the_adc_has_12_bits_left_justified():
    raw = of_kind(Rig().until(2_000 * MS), EVENT_ANALOG_FRAME)["raw"]
    assert np.all(raw[:, :2] % 16 == 0)
    assert np.array_equal(raw[:, 2], np.arange(len(raw)) % 256)


def test_noise_of_the_ideal_layers_sensors():
    rig = Rig(layer="ideal", pressure_noise_kpa=0.4, angle_noise_deg=0.05, rate_noise_deg_s=0.1)
    events = rig.until(40_000 * MS)
    analog, inclinometer = of_kind(events, EVENT_ANALOG_FRAME)["raw"], of_kind(events, EVENT_INCLINOMETER)["raw"]
    supply, chamber = ([counts_to_kpa(int(c), 0.0, 10.0, 250.0) for c in analog[:, i]] for i in range(2))
    angle, rate = [counts_to_deg(int(c)) for c in inclinometer[:, 1]], [counts_to_deg_s(int(c)) for c in inclinometer[:, 0]]
    # A step of the ADC is 0.12 kPa, of the gyro 0.06 deg/s; they add their share of the variance.
    for values, mean, spread in (
        (supply, 200.0, 0.4),
        (chamber, 0.0, 0.4),
        (angle, rig.params.mechanics.rest_deg, 0.05),
        (rate, 0.0, np.hypot(0.1, 0.061 / np.sqrt(12.0))),
    ):
        assert np.mean(values) == pytest.approx(mean, abs=5.0 * spread / np.sqrt(len(values)))
        assert np.std(values) == pytest.approx(spread, rel=0.05)
        x = np.array(values) - np.mean(values)
        assert np.mean(x[1:] * x[:-1]) / np.var(values) == pytest.approx(0.0, abs=0.06)


def test_the_rigs_sensors_are_off_by_what_was_drawn():
    rig = Rig(seed=6, pressure_noise_kpa=0.0, rate_noise_deg_s=0.0)
    events = rig.until(500 * MS)
    supply = counts_to_kpa(int(of_kind(events, EVENT_ANALOG_FRAME)["raw"][-1, 0]), 0.0, 10.0, 250.0)
    true = rig.state.x[4]
    assert supply != pytest.approx(true, abs=0.1)
    assert abs(supply - true) < 0.015 * 250.0 + 0.13
    rate = counts_to_deg_s(int(of_kind(events, EVENT_INCLINOMETER)["raw"][-1, 0]))
    assert rate == pytest.approx(rig.params.electrical.gyro_bias_deg_s, abs=0.04)


def test_loads_come_and_go_on_schedule():
    loads = [
        {"kind": "payload", "on_s": 2.0, "off_s": 6.0, "size": 400.0},
        {"kind": "contact", "on_s": 8.0, "off_s": 9.0, "size": 300.0, "angle_deg": 40.0},
    ]
    rig = Rig(layer="ideal", loads=loads)
    rig.params.air.leak_m2 = 0.0
    rig.state.x[CHAMBER] = 60.0
    seen = {}
    events = []
    for second in range(1, 11):
        events.append(rig.hold(0.0, 0.0, (second - 1) * 1_000 * MS, second * 1_000 * MS))
        seen[second] = (float(rig.state.x[ANGLE]), int(rig.state.truth.load))
    changes = of_kind(np.concatenate(events), EVENT_LOAD)
    assert changes["sample_ns"].tolist() == [2_000 * MS, 6_000 * MS, 8_000 * MS, 9_000 * MS]
    assert changes["raw"][:, :2].tolist() == [[1, 1], [0, 1], [1, 2], [0, 2]]
    assert changes["value"].tolist() == [400.0, 400.0, 300.0, 300.0]
    assert [seen[s][1] for s in (1, 4, 7, 9, 10)] == [0, 1, 0, 0, 0]
    assert int(np.frombuffer(rig.truths[1_750], rig.state.truth.dtype)["load"][0]) == 2
    # 400 deg/s2 at 80 deg are about 6 deg on Table 1's stiffness, as the sheet says for the static map.
    assert 4.5 < seen[2][0] - seen[5][0] < 8.5
    assert seen[7][0] == pytest.approx(seen[2][0], abs=0.2)


def test_a_contact_holds_the_actuator_back():
    contact = {"kind": "contact", "on_s": 0.0, "size": 2000.0, "angle_deg": 50.0}
    angles = []
    for loads in ([], [contact]):
        rig = Rig(layer="ideal", loads=loads)
        rig.params.air.leak_m2 = 0.0
        rig.state.x[CHAMBER] = 60.0
        rig.hold(0.0, 0.0, 0, 4_000 * MS)
        angles.append(rig.state.x[ANGLE])
    assert angles[0] == pytest.approx(79.9, abs=0.2)
    assert 50.0 < angles[1] < 52.0


def digest():
    """A hash of all that a busy rig sends in 0.1 s."""
    loads = [
        {"kind": "payload", "on_s": 0.02, "off_s": 0.05, "size": 400.0},
        {"kind": "contact", "on_s": 0.03, "size": 100.0, "angle_deg": 20.0},
    ]
    rig = Rig(seed=3, loads=loads)
    plan(rig, [(n * 5 * MS + FRAME_NS, 95.0 if n < 10 else 0.0, 0.0 if n < 10 else 95.0) for n in range(20)])
    rig.until(100 * MS)
    return hashlib.sha256(b"".join(rig.events + rig.truths)).hexdigest()


def test_plain_python_gives_the_compiled_kernels_bytes():
    root = Path(__file__).resolve().parents[2]
    code = "from tests.plant.test_electrical import digest; print(digest())"
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    plain = subprocess.run(
        [sys.executable, "-c", code], cwd=root, env=environment, capture_output=True, text=True, check=True, timeout=100
    )
    assert plain.stdout.strip() == digest()
