"""Where in a step a valve's spool reaches one of its two stops, or leaves it."""

from __future__ import annotations

from math import sqrt
from typing import Any

from numba import types

from softloop.plant.records import AIR_TYPE, AREA_IN, AREA_OUT, STATE_TYPE
from softloop.wire.kernel import kernel

_F8, _I8 = types.f8, types.i8
_SMALLEST_SHARE = 1e-4  # of a step: nearer to its beginning than this is at its beginning
_BISECTIONS = 24  # of a step: far below what its error is worth


@kernel(_F8(_F8, _F8, _F8, _F8))
def crossing(start: float, start_slope: float, end: float, end_slope: float) -> float:
    """Where between 0 and 1 the cubic through two values with two slopes changes sign; `start` and `end` differ in sign."""
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        s = 0.5 * (low + high)
        value = (1.0 - s) ** 2 * ((1.0 + 2.0 * s) * start + s * start_slope)
        value += s**2 * ((3.0 - 2.0 * s) * end + (s - 1.0) * end_slope)
        if (value < 0.0) == (start < 0.0):
            low = s
        else:
            high = s
    return high


@kernel(_F8(_F8, _F8, _F8))
def turn(before: float, middle: float, after: float) -> float:
    """Where between 0 and 1 the parabola through three pushes (at 0, 1/2 and 1) changes sign; 1: not within.

    A spool's push rises and falls with its coil's transient, which bends too much within a step for a straight line.
    """
    if before * after >= 0.0:
        return 1.0
    slope, bend = 4.0 * middle - 3.0 * before - after, 2.0 * (before + after) - 4.0 * middle
    if before > 0.0:
        before, slope, bend = -before, -slope, -bend
    root = sqrt(slope * slope - 4.0 * bend * before)
    # Of the two forms of the root, the one whose sum does not cancel; where the slope is not positive, the bend is.
    share = -2.0 * before / (slope + root) if slope > 0.0 else (root - slope) / (2.0 * bend)
    return min(share, 1.0) if share > _SMALLEST_SHARE else 1.0


@kernel(types.Tuple((_F8, _F8))(_F8, STATE_TYPE, _I8, _F8))
def _stop_of(area_max_m2: float, state: Any, place: int, step_s: float) -> tuple[float, float]:
    """(share of the tried step, stop) at which one spool meets a stop or leaves the one it stands at; share 1: neither."""
    before, after, valve = state.x[place], state.next[place], (place - AREA_IN) // 2
    if before <= 0.0 and state.push_before[valve] < 0.0:
        return turn(state.push_before[valve], state.push_middle[valve], state.push[valve]), 0.0
    if before >= area_max_m2 and state.push_before[valve] > 0.0:
        return turn(state.push_before[valve], state.push_middle[valve], state.push[valve]), area_max_m2
    if 0.0 <= after <= area_max_m2 or not 0.0 < before < area_max_m2:
        return 1.0, 0.0
    stop = 0.0 if after < 0.0 else area_max_m2
    share = crossing(before - stop, step_s * state.x[place + 1], after - stop, step_s * state.next[place + 1])
    return share, stop


@kernel(types.Tuple((_F8, _I8, _F8))(AIR_TYPE, STATE_TYPE, _F8))
def first_stop(air: Any, state: Any, step_s: float) -> tuple[float, int, float]:
    """(share, place, stop) of the first such instant in the tried step; share 1 where there is none."""
    share_in, stop_in = _stop_of(air.charge.area_max_m2, state, AREA_IN, step_s)
    share_out, stop_out = _stop_of(air.exhaust.area_max_m2, state, AREA_OUT, step_s)
    if share_in <= share_out:
        return share_in, AREA_IN, stop_in
    return share_out, AREA_OUT, stop_out


@kernel(types.void(_F8, STATE_TYPE, _I8))
def _hold(area_max_m2: float, state: Any, place: int) -> None:
    if state.x[place] < 0.0:
        state.x[place] = 0.0
        state.x[place + 1] = max(state.x[place + 1], 0.0)
    elif state.x[place] > area_max_m2:
        state.x[place] = area_max_m2
        state.x[place + 1] = min(state.x[place + 1], 0.0)


@kernel(types.void(AIR_TYPE, STATE_TYPE))
def hold_in_stroke(air: Any, state: Any) -> None:
    """A spool that left its seat and fell back within one step is put back on it."""
    _hold(air.charge.area_max_m2, state, AREA_IN)
    _hold(air.exhaust.area_max_m2, state, AREA_OUT)
