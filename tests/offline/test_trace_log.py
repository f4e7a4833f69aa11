"""The log of a run in one process: what a lockstep run's log holds, and readable as any other."""

import numpy as np
import pytest

from softloop.controller.config import ControllerConfig
from softloop.offline.closed_loop import SETTLE_S, RigTables, simulate_trace
from softloop.offline.log import open_log
from softloop.offline.trace_log import gate_events, write_trace
from softloop.plant.config import FaultConfig, PlantConfig
from softloop.wire.errors import BadFile
from softloop.wire.messages import constant
from softloop.wire.schedule import make_schedule

CHANNELS = {
    "cycle": "cycles", "truth": "truths", "valves": "statuses", "pressure": "pressures", "inclination": "inclinations",
}  # fmt: skip


@pytest.fixture(scope="module")
def trace():
    tables = RigTables(ControllerConfig(), PlantConfig(faults=(FaultConfig(kind="analog_silent", on_s=1.5),)))
    return simulate_trace(tables, make_schedule(SETTLE_S, 2.0, 0.5))


def test_every_record_comes_back_bit_for_bit(trace, tmp_path):
    write_trace(tmp_path / "run.mcap", trace, "here", {"bench.toml": b'name = "here"\n'})
    log = open_log(tmp_path / "run.mcap")
    assert log.problems == []
    assert (log.bench, log.finished) == ("here", True)
    for channel, name in CHANNELS.items():
        assert len(log[channel]) > 100
        for field in log[channel].dtype.names:
            np.testing.assert_array_equal(log[channel][field], getattr(trace, name)[field], err_msg=f"{channel}.{field}")


def test_commands_answer_their_ticks(trace, tmp_path):
    write_trace(tmp_path / "run.mcap", trace, "here", {})
    log = open_log(tmp_path / "run.mcap")
    command, cycle = log["command"], log["cycle"]
    for name in ("seq", "tick", "charge_current_ma", "exhaust_current_ma", "mode", "pressure_stamp_ns"):
        np.testing.assert_array_equal(command[name], cycle[name])


def test_the_gates_transitions_are_events(trace):
    events = gate_events(trace.statuses)
    gates = [int(code) for code in events["code"]]
    assert gates.index(constant("ValveStatus", "GATE_ARMED")) < gates.index(constant("ValveStatus", "GATE_FAULT"))
    fault = events[gates.index(constant("ValveStatus", "GATE_FAULT"))]
    assert fault["reason"] == constant("ValveStatus", "REASON_SENSOR_STALE") or fault["reason"] > 0
    assert fault["source"] == constant("Event", "SOURCE_GATE")
    assert list(events["seq"]) == list(range(1, len(events) + 1))


def test_a_folder_that_is_not_there_is_said(trace, tmp_path):
    with pytest.raises(BadFile, match="cannot be written"):
        write_trace(tmp_path / "gone" / "run.mcap", trace, "here", {})
