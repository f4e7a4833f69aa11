"""Free simulation of a `Structure`: from the pressures and the first state alone, compiled.

RK4 over the intervals between samples, pressures straight in between. Hysteresis is a function of the way gone since the last
step (exact while the direction holds), creep follows the angle's mean over a step; neither makes the equations stiff.
"""

from __future__ import annotations

from math import exp
from typing import Any

import numpy as np
from numba import types

from softloop.wire.kernel import array_of, kernel

_F8, _I8 = types.f8, types.i8
_VECTOR, _ROW, _MATRIX = array_of(_F8), array_of(_F8, 1, "A"), array_of(_F8, 2)
LIMIT = 1e4  # deg and beyond: the simulation has left all sense and stays here, finite for the solver


@kernel(_F8(_ROW, _I8, _I8, _F8))
def polynomial(p: Any, first: int, count: int, y: float) -> float:
    """Sum of p[first + i] y^i."""
    total = 0.0
    for i in range(count - 1, -1, -1):
        total = total * y + p[first + i]
    return total


@kernel(_F8(_F8, _F8, _F8))
def friction(z: float, moved: float, width: float) -> float:
    """Where a Bouc-Wen element (n = 1) stands after `moved` deg in one direction; between -1 and 1."""
    if moved == 0.0:
        return z
    to = 1.0 if moved > 0.0 else -1.0
    return to + (z - to) * exp(-abs(moved) / width)


@kernel(_F8(_ROW, array_of(_I8), _F8, _F8, _F8, _ROW, _VECTOR, _VECTOR, _F8, _VECTOR))
def acceleration(
    p: Any, layout: Any, d: float, y: float, v: float, pressure: Any, z: Any, creep: Any, y_start: float, share: Any
) -> float:
    """Eq. 2 and the memory's parts, deg/s2.

    `z`, `creep` and `y_start` are those of the step's start; `share` (creep,) says how far the creep has followed since.
    """
    at = layout[0]
    total = d - polynomial(p, 0, layout[0], y) * y
    for i in range(layout[1]):
        total += polynomial(p, at, layout[2], y) * pressure[i]
        at += layout[2]
    total -= polynomial(p, at, layout[3], y) * v
    at += layout[3] + 1
    for i in range(layout[4]):
        total -= p[at + i] * friction(z[i], y - y_start, p[at + layout[4] + i])
    at += 2 * layout[4]
    for i in range(layout[5]):
        total -= p[at + i] * (y - creep[i] - share[i] * (0.5 * (y + y_start) - creep[i]))
    return total


@kernel(_F8(_ROW, array_of(_I8), _F8, _ROW))
def d_of(p: Any, layout: Any, y: float, pressure: Any) -> float:
    """D as it stands in `p`, or that of a start at rest at `y` under `pressure`."""
    at = layout[0]
    if layout[8] == 0:
        return p[at + layout[1] * layout[2] + layout[3]]
    total = polynomial(p, 0, layout[0], y) * y
    for i in range(layout[1]):
        total -= polynomial(p, at, layout[2], y) * pressure[i]
        at += layout[2]
    return total


@kernel(types.void(_ROW, array_of(_I8), _F8, _VECTOR))
def creep_shares(p: Any, layout: Any, step_s: float, share: Any) -> None:
    """How far each creep term follows in `step_s`, (creep,), between 0 and 1."""
    first = layout[0] + layout[1] * layout[2] + layout[3] + 1 + 2 * layout[4] + layout[5]
    for i in range(layout[5]):
        share[i] = 1.0 - exp(-p[first + i] * step_s)


@kernel(types.void(_ROW, array_of(_I8), _VECTOR, _VECTOR, _F8, _F8, _VECTOR))
def advance_memory(p: Any, layout: Any, z: Any, creep: Any, before: float, after: float, share: Any) -> None:
    """Bring hysteresis and creep over a step in which the angle went from `before` to `after`."""
    at = layout[0] + layout[1] * layout[2] + layout[3] + 1
    for i in range(layout[4]):
        z[i] = friction(z[i], after - before, p[at + layout[4] + i])
    for i in range(layout[5]):
        creep[i] += share[i] * (0.5 * (before + after) - creep[i])


@kernel(types.void(_VECTOR, _MATRIX, _F8, _MATRIX))
def delayed(time_s: Any, pressure: Any, delay_s: float, out: Any) -> None:
    """The pressures as they were `delay_s` earlier, straight between samples, the first and last held."""
    n, j = time_s.size, 0
    for i in range(n):
        wanted = time_s[i] - delay_s
        while j < n - 2 and time_s[j + 1] <= wanted:
            j += 1
        while j > 0 and time_s[j] > wanted:
            j -= 1
        share = min(max((wanted - time_s[j]) / (time_s[j + 1] - time_s[j]), 0.0), 1.0)
        for k in range(pressure.shape[1]):
            out[i, k] = pressure[j, k] + share * (pressure[j + 1, k] - pressure[j, k])


@kernel(types.void(_ROW, array_of(_I8), _VECTOR, _MATRIX, _I8, _ROW))
def simulate(p: Any, layout: Any, time_s: Any, pressure: Any, substeps: int, out: Any) -> None:
    """Fill `out` (n,) with the angle at each time.

    Args:
        p: the flat vector of `Structure`.
        layout: `Structure.layout`.
        time_s: (n,), rising.
        pressure: (n, inputs), kPa.
        substeps: RK4 steps per interval.
    """
    y, v = p[p.size - 2], p[p.size - 1]
    lag_s = p[p.size - 3] if layout[7] > 0 else 0.0
    used = pressure
    if layout[6] > 0:
        used = np.empty_like(pressure)
        delayed(time_s, pressure, p[p.size - 3 - layout[7]], used)
    z, creep, seen = np.zeros(layout[4]), np.full(layout[5], y), y
    now, middle, after = np.empty(layout[1]), np.empty(layout[1]), np.empty(layout[1])
    d, known_s = d_of(p, layout, y, used[0]), 0.0
    none, share_half, share_full = np.zeros(layout[5]), np.zeros(layout[5]), np.zeros(layout[5])
    out[0] = y
    for n in range(time_s.size - 1):
        h = (time_s[n + 1] - time_s[n]) / substeps
        if abs(h - known_s) > 1e-9:
            creep_shares(p, layout, 0.5 * h, share_half)
            creep_shares(p, layout, h, share_full)
            known_s = h
        for s in range(substeps):
            for i in range(layout[1]):
                slope = (used[n + 1, i] - used[n, i]) / substeps
                now[i] = used[n, i] + s * slope
                middle[i] = now[i] + 0.5 * slope
                after[i] = now[i] + slope
            half = 0.5 * h
            k1 = acceleration(p, layout, d, y, v, now, z, creep, y, none)
            k2 = acceleration(p, layout, d, y + half * v, v + half * k1, middle, z, creep, y, share_half)
            k3 = acceleration(p, layout, d, y + half * (v + half * k1), v + half * k2, middle, z, creep, y, share_half)
            k4 = acceleration(p, layout, d, y + h * (v + half * k2), v + h * k3, after, z, creep, y, share_full)
            before = y
            y += h * v + h * h / 6.0 * (k1 + k2 + k3)
            v += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
            if not abs(y) < LIMIT or not abs(v) < 100.0 * LIMIT:
                out[n + 1 :] = LIMIT
                return
            if layout[4] + layout[5] > 0:
                advance_memory(p, layout, z, creep, before, y, share_full)
            if lag_s > 0.0:
                share = exp(-h / lag_s)
                ramp = (y - before) / h
                seen = share * (seen - before + lag_s * ramp) + y - lag_s * ramp
        out[n + 1] = seen if lag_s > 0.0 else y


@kernel(types.void(_MATRIX, array_of(_I8), _VECTOR, _MATRIX, _I8, _MATRIX))
def simulate_all(p: Any, layout: Any, time_s: Any, pressure: Any, substeps: int, out: Any) -> None:
    """`simulate` for each row of `p` (k, size) into each row of `out` (k, n)."""
    for i in range(p.shape[0]):
        simulate(p[i], layout, time_s, pressure, substeps, out[i])
