import os

import pytest
from rich.console import Console

from softloop.watch.echo import choose, writer
from softloop.watch.overview import Overview
from softloop.watch.top import CpuMeter, screen
from softloop.wire.channels import CAN, CYCLE, PRESSURE, STATUS, can_key, key
from softloop.wire.errors import BadConfig
from softloop.wire.messages import BadPayload, message


def made(name, **values):
    return message(name).pack(message(name).make(**values))


def text_of(overview, now_s):
    console = Console(width=140, record=True, file=open(os.devnull, "w"))  # noqa: SIM115
    console.print(screen(overview, CpuMeter(), now_s))
    return console.export_text()


def test_the_screen_says_what_is_silent_and_what_is_late():
    overview = Overview("b", {"can0": 500_000}, {1: "valves"}, lambda dlc, bitrate: 0)
    cycle = made("CycleRecord", seq=9, stamp_ns=0, woken_ns=250_000, pressure_age_ns=3_400_000, phase=2, skipped_total=4)
    status = made("ProcessStatus", process=1, pid=0, late_max_ns=1_230_000, state=1)
    overview.take([(key("b", CYCLE), cycle), (key("b", STATUS), status)], 10.0)
    text = text_of(overview, 12.5)
    for said in ("gate silent", "phase track", "pressure 3.4 ms", "ticks skipped 4", "p50 0.25", "valves", "1.23", "can0", "2.5"):
        assert said in text


def test_an_empty_bench_has_a_screen():
    assert "gate silent" in text_of(Overview("b", {}, {}, lambda dlc, bitrate: 0), 0.0)


def test_processor_time_is_read_as_the_kernel_writes_it(tmp_path):
    (tmp_path / "7").mkdir()
    stat = tmp_path / "7" / "stat"
    hertz = os.sysconf("SC_CLK_TCK")
    meter = CpuMeter(tmp_path)
    stat.write_text(f"7 (a (name) ) S 1 1 1 0 -1 4194304 1 0 0 0 {0} {0} 0 0 20 0")
    assert meter.percent(7, 100.0) is None
    stat.write_text(f"7 (a (name) ) S 1 1 1 0 -1 4194304 1 0 0 0 {hertz} {hertz // 2} 0 0 20 0")
    assert meter.percent(7, 100.5) is None  # too soon for a new figure
    assert meter.percent(7, 103.0) == pytest.approx(50.0)
    assert meter.percent(8, 103.0) is None


def test_a_choice_is_a_channel_and_its_fields():
    assert choose("b", "cycle.angle_deg,error_deg").fields == ("angle_deg", "error_deg")
    assert choose("b", "pressure").key_expr == "softloop/b/pressure"
    assert choose("b", "can").key_expr == "softloop/b/can/**"
    assert choose("b", "can/can0").key_expr == "softloop/b/can/can0/**"
    assert choose("b", "can/can0/80").key_expr == "softloop/b/can/can0/80"
    for wrong, said in (("nothing", "no channel 'nothing'"), ("pressure/x", "no channel"), ("cycle.speed", "no field 'speed'")):
        with pytest.raises(BadConfig, match=said):
            choose("b", wrong)


def test_lines_are_text_or_json():
    payload = made("PressureSample", seq=3, chamber_pressure_kpa=12.3456789)
    choice = choose("b", "pressure.seq,chamber_pressure_kpa")
    assert writer(choice, json_lines=False)(key("b", PRESSURE), payload) == "seq=3 chamber_pressure_kpa=12.3457"
    assert writer(choice, json_lines=True)(key("b", PRESSURE), payload) == '{"seq": 3, "chamber_pressure_kpa": 12.3456789}'
    nan = made("PressureSample", chamber_pressure_kpa=float("nan"))
    assert writer(choice, json_lines=True)("", nan) == '{"seq": 0, "chamber_pressure_kpa": null}'
    with pytest.raises(BadPayload):
        writer(choice, json_lines=False)("", b"x")
    frame = made("CanFrame", data=(1, 2, 3, 4, 5, 6, 7, 8))
    assert choose("b", "can").channel is CAN
    line = writer(choose("b", "can.data"), json_lines=False)(can_key("b", "can0", 0x80), frame)
    assert line == "can0/80 data=[1, 2, 3, 4, 5, 6, 7, 8]"
