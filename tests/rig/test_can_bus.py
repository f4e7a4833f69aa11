"""A rig of processes on an emulated CAN bus: arbitration, load, bus-off and recovery, and where it must, a vent."""

import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from itertools import pairwise

import can
import numpy as np
import pytest

from softloop.deploy.bench import shipped_benches
from softloop.offline.log import open_log
from softloop.offline.safe_outcome import outcome_of
from softloop.wire.can_bits import frame_bits
from softloop.wire.can_frame import FLAG_ERROR, CanFrame
from softloop.wire.messages import constant
from tests.rig.lockstep_benches import busy_cores
from tests.rig.rigs import running
from tests.rig.test_whole_rig import WIDE

SIM_CAN = shipped_benches()["sim_can"]
BUS_OFF, ACTIVE = constant("CanBusStatus", "STATE_BUS_OFF"), constant("CanBusStatus", "STATE_ACTIVE")
GATE, DRIVER = constant("CanBusStatus", "NODE_GATE"), constant("CanBusStatus", "NODE_DRIVER")
# A node behind all others fills the bus; then the gate's node is driven off it, and comes back.
SCENARIO = """
name = "bus"
description = "A full bus, and then a gate that is off it."
bench = "sim_can"
pace = "lockstep"
duration_s = 1.8
expected = "VENT"
[overrides.controller]
approach_s = 0.6
[[injections]]
kind = "bus_babble"
target = "last"
at_s = 0.7
duration_s = 0.3
[[injections]]
kind = "bus_disturb"
target = "command"
at_s = 1.2
duration_s = 0.05
"""
GUEST_ID, GUEST_S = 0x7FF, 1.5


def serialised(log, bitrate=500_000):
    """The data frames of a log by their ends, each with the time between the end before it and its own start, ns."""
    rows = np.concatenate(list(log.can.values()))
    rows = rows[(rows["flags"] & FLAG_ERROR) == 0]
    rows = rows[np.argsort(rows["stamp_ns"], kind="stable")]
    gaps = []
    for before, row in pairwise(rows):
        frame = CanFrame(0, 0, 0, int(row["arbitration_id"]), int(row["flags"]), int(row["dlc"]), bytes(row["data"]))
        gaps.append(int(row["stamp_ns"]) - frame_bits(frame) * 1_000_000_000 // bitrate - int(before["stamp_ns"]))
    return rows, np.array(gaps)


def assert_off_and_back(status):
    states = status["state"][:, GATE].tolist()
    assert BUS_OFF in states
    assert states[-1] == ACTIVE
    assert set(status["state"][:, DRIVER].tolist()) == {ACTIVE}
    assert status["disturbed"][-1] >= 32


@pytest.mark.exact
def test_at_lockstep_pace_the_same_bus_gives_the_same_bytes(tmp_path):
    scenario = tmp_path / "bus.toml"
    scenario.write_text(SCENARIO)
    with busy_cores(), ExitStack() as stack:
        rigs = []
        for _ in range(2):
            arguments = ("--no-report", "--faults", str(scenario))
            rigs.append(stack.enter_context(running(f'base = "{SIM_CAN}"\n', name="bus", arguments=arguments)))
            assert rigs[-1].finish() == 0, rigs[-1].output + rigs[-1].logs()
            assert rigs[-1].left_over() == []
        log = open_log(rigs[0].run_dir / "run.mcap")
        assert log.problems == []
        _, gaps = serialised(log)
        assert gaps.min() == 0  # back to back, and never two at once
        full = log["canbus"]["load"].max()
        assert 0.3 < full <= 1.0
        assert_off_and_back(log["canbus"])
        assert outcome_of(log, 1.8).seen == "VENT"
        command = [sys.executable, "-m", "softloop.deploy.cli", "same", str(rigs[0].run_dir), str(rigs[1].run_dir)]
        assert subprocess.run(command, check=False).returncode == 0


def babble(stop, endpoint, name):
    """A guest with the last identifier of all, which sends as fast as a bus of 500 kbit/s can take it."""
    with can.Bus(interface="zenoh", channel="can0", bench=name, endpoint=endpoint, through_bus=True) as bus:
        frame = can.Message(arbitration_id=GUEST_ID, is_extended_id=False, data=bytes([0x55] * 8))
        end = time.monotonic() + GUEST_S
        while time.monotonic() < end and not stop.wait(0.001):
            for _ in range(4):
                bus.send(frame)


@pytest.mark.rig
@pytest.mark.long
def test_a_guest_fills_the_bus_and_waits_for_all_others_and_a_gate_that_is_driven_off_it_vents(tmp_path):
    (tmp_path / "wide.toml").write_text(f'base = "{SIM_CAN}"\n{WIDE}')
    disturb = '[[faults.injections]]\nkind = "bus_disturb"\ntarget = "command"\nat_s = 4.0\nduration_s = 0.05\n'
    stop = threading.Event()
    with running(f'base = "{tmp_path}/wide.toml"\n{disturb}', name="canbus", arguments=("--no-report",)) as rig:
        rig.wait_for_word("gate armed")
        endpoint = f"unixsock-stream/{rig.folder}/softloop-canbus.sock"
        guest = threading.Thread(target=babble, args=(stop, endpoint, "canbus"), daemon=True)
        guest.start()
        try:
            assert rig.finish() == 1, rig.output + rig.logs()
        finally:
            stop.set()
            guest.join(10.0)
        assert "bus off" in rig.output
        assert rig.left_over() == []
        log = open_log(rig.run_dir / "run.mcap")
        rows, gaps = serialised(log)
        assert np.count_nonzero(rows["arbitration_id"] == GUEST_ID) > 100
        assert np.mean(gaps >= 0) > 0.999  # whose neighbours were not recorded has none
        status = log["canbus"]
        assert status["load"].max() > 0.3
        assert BUS_OFF in status["state"][:, GATE].tolist()
        assert outcome_of(log, 60.0).seen == "VENT"
