"""The valve driver's queue and its watchdog, function by function, without the physics."""

import numpy as np
import pytest

from softloop.plant import electrical as e
from softloop.plant.records import EVENT, EVENT_DRIVER, QUEUE
from tests.plant.rigs import MS, Rig

SOURCES = ("next_load_ns", "next_fault_ns", "next_echo_ns", "next_analog_ns", "next_inclinometer_ns", "next_truth_ns")


@pytest.fixture
def rig():
    rig = Rig(command_delay_ms=2.0, watchdog_ms=20.0)
    rig.state.driver.watchdog_at_ns = e.NEVER_NS
    return rig


def accept(rig, end_ns, charge=8000, exhaust=0, output=1, seq=1):
    return e.accept_command(rig.params, rig.state, end_ns, charge, exhaust, output, seq)


def apply(rig, n=0):
    events = np.zeros(8, EVENT)
    events["raw"] = 99
    return e._apply_frame(rig.params, rig.state, events, n), events


def test_a_frame_waits_with_all_that_it_carries_and_is_due_after_the_delay(rig):
    driver = rig.state.driver
    assert rig.params.electrical.command_delay_ns == 2 * MS
    assert e._frame_due_ns(rig.state) == e.NEVER_NS
    assert accept(rig, 7 * MS, 8000, 120, 2, 5)
    frame = driver.queue[driver.head]
    assert (frame.end_ns, frame.charge, frame.exhaust, frame.output, frame.seq) == (7 * MS, 8000, 120, 2, 5)
    assert (driver.waiting, driver.refused, frame.due_ns) == (1, 0, 9 * MS)
    assert e._frame_due_ns(rig.state) == 9 * MS


def test_a_frame_that_the_physics_has_passed_is_due_now(rig):
    accept(rig, 7 * MS)
    rig.state.t_ns = 12 * MS
    assert e._frame_due_ns(rig.state) == 12 * MS


def test_frames_take_effect_in_the_order_in_which_they_came(rig):
    accept(rig, 7 * MS, seq=1)
    accept(rig, 5 * MS, seq=2)
    accept(rig, 8 * MS, seq=3)
    queue = rig.state.driver.queue
    assert [int(queue[k].due_ns) for k in range(3)] == [9 * MS, 9 * MS, 10 * MS]
    seen = []
    for _ in range(3):
        apply(rig)
        seen.append((int(rig.state.driver.seq), int(rig.state.driver.command_end_ns)))
    assert seen == [(1, 7 * MS), (2, 5 * MS), (3, 8 * MS)]
    assert e._frame_due_ns(rig.state) == e.NEVER_NS


def test_the_queue_is_bounded_and_goes_round(rig):
    driver = rig.state.driver
    driver.head = QUEUE - 2
    for seq in range(QUEUE):
        assert accept(rig, seq * MS, seq=seq)
    assert not accept(rig, 0, seq=999)
    assert not accept(rig, 0, seq=999)
    assert (driver.waiting, driver.refused) == (QUEUE, 2)
    for seq in range(QUEUE):
        apply(rig)
        assert driver.seq == seq
        assert driver.head == (QUEUE - 2 + seq + 1) % QUEUE
    assert (driver.waiting, driver.accepted) == (0, QUEUE)


def test_a_frame_drives_the_coils_and_winds_the_watchdog(rig):
    state, driver = rig.state, rig.state.driver
    state.t_ns = 11 * MS
    driver.state = e.DRIVER_OK
    accept(rig, 7 * MS, 8000, 120)
    n, _ = apply(rig, 3)
    assert n == 3, "a driver that was well says nothing"
    assert (state.command_charge_ma, state.command_exhaust_ma) == (80.0, 1.2)
    assert (driver.command_end_ns, driver.command_applied_ns) == (7 * MS, 11 * MS)
    assert driver.watchdog_at_ns == 31 * MS
    assert (driver.accepted, driver.waiting) == (1, 0)


def test_coils_get_no_more_than_the_driver_can_give(rig):
    limit = rig.params.electrical.current_max_ma
    accept(rig, 0, round(100 * limit) + 500, round(100 * limit) + 700)
    apply(rig)
    assert (rig.state.command_charge_ma, rig.state.command_exhaust_ma) == (limit, limit)
    accept(rig, 0, round(100 * limit) - 500, round(100 * limit) - 700)
    apply(rig)
    assert rig.state.command_charge_ma == pytest.approx(limit - 5.0)
    assert rig.state.command_exhaust_ma == pytest.approx(limit - 7.0)


def test_a_good_frame_ends_the_watchdogs_vent_and_says_so(rig):
    rig.state.t_ns = 4 * MS
    rig.state.driver.state = e.DRIVER_WATCHDOG
    accept(rig, 0)
    n, events = apply(rig, 2)
    assert n == 3
    assert rig.state.driver.state == e.DRIVER_OK
    event = events[2]
    assert (event["kind"], event["sample_ns"], event["end_ns"]) == (EVENT_DRIVER, 4 * MS, 4 * MS)
    assert event["raw"].tolist() == [e.DRIVER_OK, 0, 0, 0]
    assert np.delete(events["raw"], 2, axis=0).tolist() == [[99] * 4] * 7, "the other events are not its own"


def test_the_watchdog_vents_once_and_says_so(rig):
    state, events = rig.state, np.zeros(8, EVENT)
    events["raw"] = 99
    accept(rig, 0, 9000, 0)
    apply(rig)
    state.t_ns = 20 * MS
    assert e._watchdog(rig.params, state, events, 1) == 2
    assert (state.command_charge_ma, state.command_exhaust_ma) == (0.0, rig.params.electrical.vent_ma)
    assert (state.driver.state, state.driver.watchdog_at_ns) == (e.DRIVER_WATCHDOG, e.NEVER_NS)
    event = events[1]
    assert (event["kind"], event["sample_ns"], event["end_ns"]) == (EVENT_DRIVER, 20 * MS, 20 * MS)
    assert event["raw"].tolist() == [e.DRIVER_WATCHDOG, 0, 0, 0]


@pytest.mark.parametrize("fault", ["commands_lost", "power_lost"])
def test_a_frame_that_does_not_reach_the_driver_changes_nothing(rig, fault):
    state, driver = rig.state, rig.state.driver
    driver.state, driver.seq, driver.head = e.DRIVER_WATCHDOG, 3, QUEUE - 1
    state.broken[fault] = 1
    accept(rig, 7 * MS, 9000, 100, 1, 8)
    accept(rig, 8 * MS, 9000, 100, 1, 9)
    before = (float(state.command_charge_ma), float(state.command_exhaust_ma))
    n, events = apply(rig, 2)
    assert n == 2
    assert events["raw"].tolist() == [[99] * 4] * 8
    assert (driver.head, driver.waiting, driver.seq, driver.accepted) == (0, 1, 3, 0)
    assert (driver.state, driver.watchdog_at_ns) == (e.DRIVER_WATCHDOG, e.NEVER_NS)
    assert (state.command_charge_ma, state.command_exhaust_ma) == before != (90.0, 1.0)


def test_a_watchdog_without_power_cannot_vent(rig):
    state, events = rig.state, np.zeros(4, EVENT)
    events["raw"] = 99
    accept(rig, 0, 9000, 0)
    apply(rig)
    state.broken.power_lost = 1
    assert e._watchdog(rig.params, state, events, 1) == 1
    assert (state.command_charge_ma, state.command_exhaust_ma) == (90.0, 0.0)
    assert (state.driver.state, state.driver.watchdog_at_ns) == (e.DRIVER_OK, e.NEVER_NS)
    assert events["raw"].tolist() == [[99] * 4] * 4


def test_new_currents_reach_the_physics(rig):
    rig.params.air.coil_lag_s = 0.0
    accept(rig, 0, 9000, 300)
    apply(rig)
    assert (rig.state.coil_charge_ma, rig.state.coil_exhaust_ma) == (90.0, 3.0)


def test_the_next_happening_is_the_first_of_all(rig):
    state = rig.state
    for name in SOURCES:
        state[name] = 100 * MS
    assert e.next_event_ns(rig.params, state) == 100 * MS
    for k, name in enumerate(SOURCES):
        state[name] = (90 - k) * MS
        assert e.next_event_ns(rig.params, state) == (90 - k) * MS
    state.driver.watchdog_at_ns = 50 * MS
    assert e.next_event_ns(rig.params, state) == 50 * MS
    accept(rig, 20 * MS)
    assert e.next_event_ns(rig.params, state) == 22 * MS
