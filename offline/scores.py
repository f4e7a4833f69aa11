"""How well a run in this process followed its trajectory: pure functions of its records.

Errors are the plant's true angle less the reference, at every tick of PHASE_TRACK from its first, none left out. A run in which
the gate went to FAULT, or that did not come to the end of its trajectory, has no errors that could be compared with another
run's: all its scores are infinite.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from softloop.offline import metrics
from softloop.offline.metrics import Floats

if TYPE_CHECKING:
    from softloop.offline.closed_loop import Run

RECOVERED_DEG = 0.5  # a load is dealt with once |error| stays under this
RECOVERED_S = 0.2  # for at least this long
PEAK_S = 2.0  # after a load came or left: what is later is the trajectory's


@dataclass(frozen=True)
class Scores:
    """The figures of one run; all are better when smaller.

    Attributes:
        max_error_deg: largest |error|.
        steady_error_deg: largest |error| within the last 2 s of every dwell; None where the trajectory has no dwell.
        rms_error_deg: root mean square of the error.
        switches_per_s: changes of the working mode per second.
        peak_deg: with loads, largest |error| within 2 s after one came or left; None without.
        recovery_s: with loads, the longest time from such a change until |error| stays under 0.5 deg for 0.2 s, counted until
            the next change; infinite where it never does. None without loads.
    """

    max_error_deg: float
    steady_error_deg: float | None
    rms_error_deg: float
    switches_per_s: float
    peak_deg: float | None = None
    recovery_s: float | None = None


def run_scores(run: Run, changes_ns: Sequence[int] = ()) -> Scores:
    """The scores of a run.

    Args:
        run: its records.
        changes_ns: rig clock at which loads come and leave, ascending; those outside PHASE_TRACK do not count.
    """
    cycles, truths = _tracked(run)
    error_deg = truths["angle_deg"] - cycles["reference_deg"]
    if run.fault or not run.completed or not len(cycles) or not np.isfinite(error_deg).all():
        return lost(with_loads=bool(changes_ns))
    size, steady = np.abs(error_deg), metrics.errors_at(cycles["stamp_ns"], error_deg, cycles).steady
    peak, recovery = _load_scores(cycles["stamp_ns"], size, changes_ns)
    return Scores(
        max_error_deg=float(size.max()),
        steady_error_deg=float(size[steady].max()) if steady.any() else None,
        rms_error_deg=float(np.sqrt(np.mean(error_deg**2))),
        switches_per_s=metrics.switches_per_s(cycles, [(0, len(cycles))]) or 0.0,
        peak_deg=peak,
        recovery_s=recovery,
    )


def _tracked(run: Run) -> tuple[NDArray[Any], NDArray[Any]]:
    """The records of PHASE_TRACK; not copied where they are one stretch, as that costs more than the scores do."""
    track = run.cycles["phase"] == metrics.PHASE_TRACK
    stretches = metrics.runs_of(track)
    if len(stretches) == 1:
        part = slice(*stretches[0])
        return run.cycles[part], run.truths[part]
    return run.cycles[track], run.truths[track]


def lost(*, with_loads: bool = False) -> Scores:
    """The scores of a run that was not brought to its end."""
    load_score = inf if with_loads else None
    return Scores(inf, inf, inf, inf, load_score, load_score)


def _load_scores(stamps_ns: NDArray[Any], size_deg: Floats, changes_ns: Sequence[int]) -> tuple[float | None, float | None]:
    inside = [at_ns for at_ns in changes_ns if stamps_ns[0] <= at_ns <= stamps_ns[-1]]
    if not inside:
        return None, None
    ends = [*inside[1:], int(stamps_ns[-1]) + 1]
    peaks, times = [], []
    for at_ns, end_ns in zip(inside, ends, strict=True):
        after = (stamps_ns >= at_ns) & (stamps_ns < end_ns)
        near = after & (stamps_ns <= at_ns + round(PEAK_S * 1e9))
        peaks.append(float(size_deg[near].max(initial=0.0)))
        times.append(recovery_s((stamps_ns[after] - at_ns) * 1e-9, size_deg[after]))
    return max(peaks), max(times)


def recovery_s(time_s: Floats, size_deg: Floats) -> float:
    """When |error|, once it was at RECOVERED_DEG or above, is under it for RECOVERED_S; 0 if it never was, inf if never back.

    Args:
        time_s: (n,) since the change.
        size_deg: (n,) |error|.
    """
    first = int(np.argmax(size_deg >= RECOVERED_DEG))
    if not len(size_deg) or size_deg[first] < RECOVERED_DEG:
        return 0.0
    for start, end in metrics.runs_of(size_deg < RECOVERED_DEG):
        if start > first and time_s[end - 1] - time_s[start] >= RECOVERED_S:
            return float(time_s[start])
    return inf
