"""A shorter version of `benchmarks/accuracy.py`, on currents of the closed loop in one process, and its reading of a log."""

from pathlib import Path

import numpy as np
import pytest
from accuracy import IDEAL_LIMITS, RIG_LIMITS, errors, oracle_run, replay
from logged_currents import of_closed_loop, of_log

from softloop.devices.protocols.can_frames import VALVE_COMMAND_ID, ValveCommandFrame, encode_valve_command
from softloop.devices.protocols.wire_time import can_frame_ns
from softloop.offline.log import Log
from softloop.plant.config import PlantConfig
from softloop.wire.errors import BadFile
from softloop.wire.messages import message

STEP_NS = 1000 * PlantConfig().step_us
BENCH = b'[can.can0]\nbitrate = 250000\n\n[plant]\nlayer = "rig"\nseed = 3\n'
FIRST_NS, PERIOD_NS, FRAMES = 7_000_000_000, 5_000_000, 400
WIRE_NS = can_frame_ns(8, 250_000)


def test_the_ideal_layer_against_scipy():
    currents = of_closed_loop("ideal").until(8.0)
    angle, pressure = errors(replay(currents, STEP_NS), oracle_run(currents))
    assert angle < IDEAL_LIMITS[0]
    assert pressure < IDEAL_LIMITS[1]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_rig_layer_against_a_twentieth_of_the_step(seed):
    currents = of_closed_loop("rig", seed).until(12.0)
    found, truth = (replay(currents, step_ns) for step_ns in (STEP_NS, STEP_NS // 20))
    angle, pressure = errors(found, truth)
    assert angle < RIG_LIMITS[0]
    assert pressure < RIG_LIMITS[1]
    assert np.ptp(truth[0]) > 40.0  # the sequence moves it through its range


def a_log() -> Log:
    """Frames of a rig that vents for 100 frames and then follows a trajectory; the 50th frame's CRC is wrong."""
    frames, cycles, truths = (np.zeros(FRAMES, message(name).dtype) for name in ("CanFrame", "CycleRecord", "PlantTruth"))
    stamps_ns = FIRST_NS + PERIOD_NS * np.arange(FRAMES)
    for n in range(FRAMES):
        data = encode_valve_command(ValveCommandFrame(n % 15, 0, 10 * n, 20 * n, n))
        frames["data"][n] = np.frombuffer(data, np.uint8)
    frames["data"][50, 0] ^= 1
    frames["stamp_ns"], frames["dlc"], frames["arbitration_id"] = stamps_ns, 8, VALVE_COMMAND_ID
    cycles["stamp_ns"], cycles["trajectory_ns"] = stamps_ns, stamps_ns - stamps_ns[100]
    truths["command_end_ns"] = stamps_ns + WIRE_NS
    truths["command_end_ns"][50] = truths["command_end_ns"][49]
    log = Log(Path("a.mcap"), attachments={"bench.toml": BENCH})
    log.channels, log.can = {"cycle": cycles, "truth": truths}, {("can0", VALVE_COMMAND_ID): frames}
    return log


def test_a_log_gives_what_the_driver_took_at_the_frames_ends():
    currents = of_log(a_log(), 1.0)
    taken = np.delete(np.arange(FRAMES), 50)
    taken = taken[PERIOD_NS * taken + WIRE_NS <= PERIOD_NS * 300]  # 1 s from frame 100
    assert currents.end_ns.tolist() == (PERIOD_NS * (taken + 1)).tolist()
    assert currents.charge_ma == pytest.approx(0.1 * taken)
    assert currents.exhaust_ma == pytest.approx(0.2 * taken)
    assert (currents.plant.layer, currents.plant.seed) == ("rig", 3)
    assert currents.from_ns == PERIOD_NS * 101 - WIRE_NS


def test_a_log_that_ends_too_early_is_refused():
    with pytest.raises(BadFile, match="does not hold 60 s"):
        of_log(a_log(), 60.0)


def test_frame_ends_that_the_plant_did_not_see_are_refused():
    log = a_log()
    log["truth"]["command_end_ns"][200] += 1
    with pytest.raises(BadFile, match="1 of 399 frame ends"):
        of_log(log, 1.0)
