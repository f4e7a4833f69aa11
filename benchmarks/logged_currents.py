"""Valve currents with the instants at which their frames ended on the wire: of a log, or of the closed loop in one process."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softloop.controller.config import ControllerConfig
from softloop.controller.records import CYCLE
from softloop.deploy.bench import shipped_benches
from softloop.devices.protocols.can_frames import DLC, VALVE_COMMAND_ID, E2eReceiver, decode_valve_command
from softloop.devices.protocols.quantise_kernels import counts_to_current, current_to_counts
from softloop.devices.protocols.wire_time import can_frame_ns
from softloop.offline.closed_loop import simulate_run
from softloop.offline.log import Log
from softloop.plant.config import PlantConfig
from softloop.plant.physics import settle_inputs
from softloop.wire.can_config import CanConfig
from softloop.wire.errors import BadFile, Lost

TICK_NS = 5_000_000
LOOP_NS = 600_000  # from tick to bus in the closed loop
_MAX_DELTA = 4  # as the driver's receiver has it
_S = 1_000_000_000
_RUN_LIMIT_S = 240.0


@dataclass(frozen=True)
class Currents:
    """Currents and the instants at which their frames end on the wire, from the rig's rest at 0; shapes (n,).

    Attributes:
        plant: the rig that they moved.
        from_ns: where the trajectory begins.
    """

    end_ns: np.ndarray
    charge_ma: np.ndarray
    exhaust_ma: np.ndarray
    plant: PlantConfig
    from_ns: int

    def until(self, seconds: float) -> Currents:
        """Those of the first `seconds`."""
        n = int(np.searchsorted(self.end_ns, seconds * _S))
        return Currents(self.end_ns[:n], self.charge_ma[:n], self.exhaust_ma[:n], self.plant, self.from_ns)


def of_log(log: Log, seconds: float) -> Currents:
    """All that the driver took, from its first frame to `seconds` after the start of the trajectory.

    Raises BadFile when the log has no simulated rig or not so much of a trajectory, when the rig carried loads, or when the
    plant says that its frames ended at other instants.
    """
    plant, bus = _rig(log)
    start_ns, last_ns = _trajectory(log, seconds)
    frames = log.can.get((plant.can_valves, VALVE_COMMAND_ID), np.zeros(0, log["event"].dtype))
    receiver, rows, frame_ns = E2eReceiver(VALVE_COMMAND_ID, _MAX_DELTA), [], can_frame_ns(DLC, bus.bitrate)
    for frame in frames:
        data = frame["data"].tobytes()
        if receiver.judge(data).usable:
            command = decode_valve_command(data)
            rows.append((int(frame["stamp_ns"]) + frame_ns, command.charge_counts, command.exhaust_counts))
    if not rows:
        raise BadFile(f"{log.path}: no valve frames on {plant.can_valves}")
    end_ns, charge, exhaust = (np.array(column, np.int64) for column in zip(*rows, strict=True))
    _check_ends(log, end_ns)
    kept, origin_ns = end_ns <= last_ns, int(end_ns[0]) - TICK_NS  # before its first frame the rig is at rest
    currents_ma = [np.array([counts_to_current(int(n)) for n in counts[kept]]) for counts in (charge, exhaust)]
    return Currents(end_ns[kept] - origin_ns, currents_ma[0], currents_ma[1], plant, start_ns - origin_ns)


def _rig(log: Log) -> tuple[PlantConfig, CanConfig]:
    """The simulated rig of a log, and its valves' bus."""
    bench = tomllib.loads(log.text("bench.toml"))
    if "plant" not in bench:
        raise BadFile(f"{log.path}: no simulated rig in its bench file")
    plant = PlantConfig.model_validate(bench["plant"])
    if plant.loads or plant.command_delay_ms:
        raise BadFile(f"{log.path}: a rig with loads or an added delay is not replayed")
    return plant, CanConfig.model_validate(bench["can"][plant.can_valves])


def _trajectory(log: Log, seconds: float) -> tuple[int, int]:
    """Rig clock of the trajectory's start, and `seconds` after it."""
    cycles = log["cycle"]
    on = cycles[cycles["trajectory_ns"] >= 0]
    if not len(on) or on["trajectory_ns"][-1] < round(seconds * _S) - 2 * TICK_NS:
        raise BadFile(f"{log.path}: does not hold {seconds:g} s of a trajectory")
    start_ns = int(on["stamp_ns"][0] - on["trajectory_ns"][0])
    return start_ns, start_ns + round(seconds * _S)


def _check_ends(log: Log, end_ns: np.ndarray) -> None:
    """The plant's truth names the end of the last frame that it took: each must be one of ours."""
    told = np.unique(log["truth"]["command_end_ns"])
    strange = np.setdiff1d(told[told >= end_ns[0]], end_ns)
    if len(strange):
        raise BadFile(f"{log.path}: {len(strange)} of {len(told)} frame ends in the truth are not those of its valve frames")


def of_closed_loop(layer: str, seed: int = 1) -> Currents:
    """T2 with the default law in one process; every tick's frame ends at the same time after it."""
    plant = PlantConfig.model_validate({"layer": layer, "seed": seed})
    cycles: Any = simulate_run(ControllerConfig(trajectory="t2"), plant).cycles
    assert cycles.dtype == CYCLE
    charge, exhaust = (
        np.array([counts_to_current(current_to_counts(float(ma))) for ma in cycles[name]])
        for name in ("charge_current_ma", "exhaust_current_ma")
    )
    end_ns = cycles["stamp_ns"] - cycles["stamp_ns"][0] + TICK_NS + LOOP_NS + can_frame_ns(DLC, CanConfig().bitrate)
    started = int(np.argmax(cycles["trajectory_ns"] >= 0))
    return Currents(end_ns, charge, exhaust, plant, int(end_ns[started]))


def make_run(folder: Path, layer: str, seed: int) -> Path:
    """Run T2 with every process at wall pace; the run's directory. Raises Lost when it left no log."""
    name = f"accuracy-{layer}-{seed}"
    bench, run_dir = folder / f"{name}.toml", folder / name
    base = shipped_benches()["sim_t2"]
    bench.write_text(f'base = "{base}"\nname = "{name}"\n\n[plant]\nlayer = "{layer}"\nseed = {seed}\n')
    command = [
        sys.executable,
        "-m",
        "softloop.deploy.cli",
        "run",
        str(bench),
        "--run-dir",
        str(run_dir),
        "--no-report",
        "--quiet",
    ]
    # A run that is no valid evidence of tracking still gives currents; one that ended early is refused when it is read.
    subprocess.run([*command, "--no-report", "--quiet"], check=False, timeout=_RUN_LIMIT_S)
    if not list(run_dir.glob("*.mcap")):
        raise Lost(f"the run of {bench.name} left no log")
    return run_dir


def apply(params: Any, state: Any, charge_ma: float, exhaust_ma: float) -> None:
    """Give the driver its currents at the state's time."""
    state.command_charge_ma, state.command_exhaust_ma = charge_ma, exhaust_ma
    settle_inputs(params, state)
