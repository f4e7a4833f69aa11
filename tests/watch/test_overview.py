"""Rates, gaps, loads and lateness from messages that are made up."""

import numpy as np
import pytest

from softloop.watch.overview import LATE_EDGES_US, Overview
from softloop.wire.channels import CAN_BUS, CYCLE, EVENT, PRESSURE, STATUS, can_key, key
from softloop.wire.messages import message

BENCH = "b"


def made(name, **values):
    return message(name).pack(message(name).make(**values))


def overview():
    return Overview(BENCH, {"can0": 500_000}, {4: "recorder"}, lambda dlc, bitrate: (47 + 8 * dlc) * 1_000_000_000 // bitrate)


def pressures(first, last):
    return [(key(BENCH, PRESSURE), made("PressureSample", seq=seq)) for seq in range(first, last)]


def test_a_rate_is_counted_over_the_window_only():
    seen = overview()
    for look in range(41):
        seen.take(pressures(1 + 10 * look, 11 + 10 * look), now_s=0.1 * look)
    assert seen.lanes[key(BENCH, PRESSURE)].rate_hz == pytest.approx(100.0)
    seen.take([], now_s=6.0)
    seen.take([], now_s=8.0)
    assert seen.lanes[key(BENCH, PRESSURE)].rate_hz == 0.0


def test_gaps_are_counted_and_several_senders_are_no_gap():
    seen = overview()
    seen.take(pressures(1, 5) + pressures(8, 10), 1.0)
    assert seen.lanes[key(BENCH, PRESSURE)].missing == 3
    seen.take([(key(BENCH, EVENT), made("Event", seq=seq)) for seq in (1, 7, 2)], 1.0)
    assert seen.lanes[key(BENCH, EVENT)].missing == 0
    assert [e.seq for e in seen.events] == [1, 7, 2]


def test_the_load_of_a_bus_is_the_time_its_frames_stand_on_it():
    seen = overview()
    frames = [(can_key(BENCH, "can0", 0x80), made("CanFrame", seq=1, dlc=8)) for _ in range(450)]
    seen.take([], 0.0)
    seen.take(frames, 1.0)
    assert seen.buses["can0"].load_percent == pytest.approx(450 * (47 + 64) / 500_000 * 100)


def test_an_emulated_bus_speaks_for_itself():
    seen = Overview(BENCH, {"can0": 500_000}, {}, lambda dlc, bitrate: 0, emulated=("can0",))
    assert seen.buses["can0"].words == ""
    told = {"load": 0.148, "nodes": 4, "state": [0, 0, 3, 0, 0, 0, 0, 0], "transmit_errors": [0, 0, 255, 0, 0, 0, 0, 0]}
    seen.take([(key(BENCH, CAN_BUS), made("CanBusStatus", seq=1, disturbed=32, waited_max_ns=240_000, **told))], 1.0)
    assert seen.buses["can0"].load_percent == pytest.approx(14.8)
    assert seen.buses["can0"].words == "gate bus off (255/0), 32 disturbed, waited 0.24 ms at most"
    seen.take([(key(BENCH, CAN_BUS), made("CanBusStatus", seq=2, bus=7))], 2.0)  # of no bus that is known
    seen.take([(key(BENCH, CAN_BUS), made("CanBusStatus", seq=3, nodes=255, state=[9] * 8))], 3.0)


def test_lateness_is_of_ticks_and_early_ones_count_as_on_time():
    seen = overview()
    late_ns = [-5_000, 15_000, 1_500_000]
    seen.take(
        [(key(BENCH, CYCLE), made("CycleRecord", seq=i + 1, stamp_ns=10**9, woken_ns=10**9 + n)) for i, n in enumerate(late_ns)]
    )
    histogram = seen.lateness_histogram()
    assert sum(histogram) == 3
    assert histogram[0] == 1
    assert histogram[int(np.searchsorted(LATE_EDGES_US, 1500.0)) - 1] == 1
    assert seen.lateness_spread_us()["max"] == pytest.approx(1500.0)
    assert len(seen.cycles) == 3


def test_a_status_goes_by_the_name_of_its_process_and_rubbish_is_counted():
    seen = overview()
    seen.take([(key(BENCH, STATUS), made("ProcessStatus", process=4, pid=7)), (key(BENCH, CYCLE), b"rubbish")], 3.0)
    assert seen.statuses["recorder"][0].pid == 7
    assert seen.statuses["recorder"][1] == 3.0
    assert seen.malformed == 1
    seen.take([("softloop/other/cycle", b"x"), ("softloop/b/nothing", b"x")], 3.0)
    assert len(seen.lanes) == 2


def test_what_is_broken_is_known_until_it_leaves_or_the_rig_begins_anew():
    seen = overview()
    fault = {"source": 3, "kind": 8, "reason": 7}
    for code, standing in ((1, {7: 1}), (1, {7: 2}), (0, {7: 1}), (0, {}), (0, {}), (1, {7: 1})):
        seen.take([(key(BENCH, EVENT), made("Event", code=code, **fault))], 1.0)
        assert +seen.broken == standing
    seen.take([(key(BENCH, STATUS), made("ProcessStatus", process=3, state=1))], 2.0)
    assert +seen.broken == {7: 1}
    seen.take([(key(BENCH, STATUS), made("ProcessStatus", process=3, state=0))], 2.0)
    assert +seen.broken == {}
