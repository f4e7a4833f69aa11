"""One simulated trial of a law: a trajectory, perhaps with a payload that comes and goes, and its figures against the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softloop.controller.config import ControllerConfig
from softloop.offline.closed_loop import Run, simulate_run
from softloop.offline.metrics import dwells, steady_spans_ns, switches_per_s
from softloop.plant.config import LoadConfig, PlantConfig

Floats = NDArray[np.float64]

# The payload comes and goes on T1's two dwells at 100 deg, 1.5 s after they began, and is there 400 deg/s2.
PAYLOAD_DEG_S2 = 400.0
PAYLOAD_ON_S, PAYLOAD_OFF_S = 12.5, 23.5
_PAYLOAD_SIZE = PAYLOAD_DEG_S2 / float(np.sin(np.radians(100.0)))  # `size` holds at 90 deg
_WATCHED_S = 2.5  # after a change of load, until the dwell ends
RECOVERED_DEG = 0.5
_LOST_DEG = 1e3  # stands for an error that is no number


@dataclass(frozen=True)
class Trial:
    """What happened in one run.

    Attributes:
        max_deg, rms_deg: of |true angle less reference| on the trajectory.
        steady_deg: its maximum over the last 2 s of every dwell; 0 without dwells.
        switches_per_s: mode changes per second, on dwells where there are any, else on the whole trajectory.
        effort_ma_s: sum of |changes| of both commanded currents per second.
        peak_deg, recovery_s: after the payload came, largest error and the time of the last one over 0.5 deg; 0 without.
        left_peak_deg, left_recovery_s: the same after it left.
    """

    max_deg: float
    rms_deg: float
    steady_deg: float
    switches_per_s: float
    effort_ma_s: float
    peak_deg: float = 0.0
    recovery_s: float = 0.0
    left_peak_deg: float = 0.0
    left_recovery_s: float = 0.0


# From the plant's start to the first tick, about: when a load did come and go is then found by the truth's own flag.
_SETTLE_S = 0.5


def lead_s(controller: ControllerConfig) -> float:
    """From the plant's start to the trajectory's first point in a simulated run, about."""
    return controller.approach_s + _SETTLE_S


def run_trial(controller: ControllerConfig, plant: PlantConfig, *, payload: bool = False) -> Trial:
    """Run and judge. Raises BadFile or BadConfig."""
    if payload:
        at = lead_s(controller)
        load = LoadConfig(kind="payload", on_s=at + PAYLOAD_ON_S, off_s=at + PAYLOAD_OFF_S, size=_PAYLOAD_SIZE)
        plant = plant.model_copy(update={"loads": (load,)})
    return judge(simulate_run(controller, plant))


def judge(run: Run) -> Trial:
    """The figures of a run; loads are found in the truth. One that the gate broke off counts as lost in every figure."""
    if not run.completed:
        return Trial(**dict.fromkeys(Trial.__dataclass_fields__, _LOST_DEG))
    on = run.cycles["trajectory_ns"] >= 0
    cycles, truths = run.cycles[on], run.truths[on]
    error = np.abs(truths["angle_deg"] - cycles["reference_deg"])
    error = np.where(np.isfinite(error), np.minimum(error, _LOST_DEG), _LOST_DEG)
    currents = np.diff(cycles["charge_current_ma"]), np.diff(cycles["exhaust_current_ma"])
    seconds = 1e-9 * float(cycles["stamp_ns"][-1] - cycles["stamp_ns"][0])
    spans = dwells(cycles) or [(0, len(cycles))]
    steady = np.zeros(len(cycles), bool)
    for first, last in steady_spans_ns(cycles):
        steady |= (cycles["stamp_ns"] >= first) & (cycles["stamp_ns"] <= last)
    changes = np.diff(truths["load"].astype(np.int64))
    came, left = (_after(error, cycles["stamp_ns"], np.flatnonzero(changes * sign > 0)) for sign in (1, -1))
    return Trial(
        max_deg=float(error.max()),
        rms_deg=float(np.sqrt(np.mean(error**2))),
        steady_deg=float(error[steady].max()) if steady.any() else 0.0,
        switches_per_s=switches_per_s(cycles, spans) or 0.0,
        effort_ma_s=float(sum(np.abs(np.nan_to_num(c)).sum() for c in currents) / seconds),
        peak_deg=came[0],
        recovery_s=came[1],
        left_peak_deg=left[0],
        left_recovery_s=left[1],
    )


def _after(error: Floats, stamps_ns: NDArray[np.int64], places: NDArray[np.int64]) -> tuple[float, float]:
    """Largest error in the time after the first of `places`, and when it was last over RECOVERED_DEG, s; zeros without."""
    if not len(places):
        return 0.0, 0.0
    since = 1e-9 * (stamps_ns - stamps_ns[places[0]])
    watched = (since >= 0.0) & (since <= _WATCHED_S)
    over = since[watched & (error > RECOVERED_DEG)]
    return float(error[watched].max()), float(over[-1]) if len(over) else 0.0
