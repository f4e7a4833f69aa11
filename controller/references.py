"""Reference trajectories: how they are made (Python) and read at a time (a kernel).

The law needs the third derivative (the rate of w, Eq. 34, stands in Eq. 42), so every trajectory here is at least three times
continuously differentiable: polynomials of degree seven between points, sums of sines, or a spline of degree seven.
A plan is `kind`, `knots` (n + 1,) in s and `table` (n, 8): for polynomials the coefficients of each stretch, ascending, in
time since its knot; for sines a row (amplitude, frequency in rad/s, phase) per tone and the offset in the last row.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from math import cos, pi, sin
from pathlib import Path
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray
from scipy.interpolate import PPoly, make_interp_spline

from softloop.controller.records import REFERENCE, REFERENCE_TYPE
from softloop.wire.errors import BadFile
from softloop.wire.kernel import array_of, kernel, new_record

POLYNOMIALS, SINES = 0, 1
_F8 = types.f8
Floats = NDArray[np.float64]

# T1 of the paper is shown in a figure only. Ours: through these angles, moves of 1.5 s, dwells of 4 s.
T1_ANGLES_DEG = (40.0, 70.0, 100.0, 130.0, 100.0, 70.0, 40.0)
T1_MOVE_S = 1.5
T1_DWELL_S = 4.0
# T2 of the paper is "[0, 0.5] Hz multi-sine". Ours: ten tones of equal size, phases by seed, spanning these angles.
T2_TONES_HZ = tuple(0.05 * k for k in range(1, 11))
T2_SPAN_DEG = (45.0, 115.0)
T2_SECONDS = 60.0
# Excitation for identification: pressure, twenty tones up to 1 Hz or 0.5 Hz, over a span the rig reaches from both sides.
EXCITATION_SPAN_KPA = (5.0, 110.0)
EXCITATION_SECONDS = 160.0


@dataclass(frozen=True)
class Plan:
    """A trajectory as kernels read it; see the module's text."""

    kind: int
    knots: Floats
    table: Floats

    @property
    def duration_s(self) -> float:
        return float(self.knots[-1])

    @property
    def duration_ns(self) -> int:
        return round(self.duration_s * 1e9)

    def at(self, time_s: float) -> Any:
        """The `REFERENCE` record at a time; outside the plan its first or last point."""
        point = new_record(REFERENCE)
        reference_at(self.kind, self.knots, self.table, time_s, point)
        return point

    def sample(self, times_s: Floats) -> Floats:
        """Value, rate, acceleration and jerk at each time, shape (n, 4)."""
        found = np.empty((len(times_s), 4))
        sample_plan(self.kind, self.knots, self.table, np.ascontiguousarray(times_s, np.float64), new_record(REFERENCE), found)
        return found


@kernel(types.void(array_of(_F8, 1, "A"), _F8, REFERENCE_TYPE))
def polynomial_at(coefficients: Floats, time_s: float, point: Any) -> None:
    """A polynomial of degree seven and three derivatives, by Horner's rule."""
    value, rate, second, third = 0.0, 0.0, 0.0, 0.0
    for k in range(7, -1, -1):
        third = third * time_s + 3.0 * second
        second = second * time_s + 2.0 * rate
        rate = rate * time_s + value
        value = value * time_s + coefficients[k]
    point.value = value
    point.rate = rate
    point.acceleration = second
    point.jerk = third


@kernel(types.void(array_of(_F8, 2), _F8, REFERENCE_TYPE))
def sines_at(table: Floats, time_s: float, point: Any) -> None:
    """A sum of sines with offset, and three derivatives."""
    last = table.shape[0] - 1
    point.value = table[last, 0]
    point.rate = 0.0
    point.acceleration = 0.0
    point.jerk = 0.0
    for k in range(last):
        amplitude, omega = table[k, 0], table[k, 1]
        s = amplitude * sin(omega * time_s + table[k, 2])
        c = amplitude * cos(omega * time_s + table[k, 2])
        point.value += s
        point.rate += omega * c
        point.acceleration -= omega * omega * s
        point.jerk -= omega * omega * omega * c


@kernel(types.void(types.i8, array_of(_F8), array_of(_F8, 2), _F8, REFERENCE_TYPE))
def reference_at(kind: int, knots: Floats, table: Floats, time_s: float, point: Any) -> None:
    """The trajectory at a time; before and after it stands its first and last point."""
    time_s = min(max(time_s, 0.0), knots[knots.size - 1])
    if kind == SINES:
        sines_at(table, time_s, point)
        return
    after = int(np.searchsorted(knots, time_s, side="right"))
    stretch = min(max(after - 1, 0), table.shape[0] - 1)
    polynomial_at(table[stretch], time_s - knots[stretch], point)


@kernel(types.void(types.i8, array_of(_F8), array_of(_F8, 2), array_of(_F8), REFERENCE_TYPE, array_of(_F8, 2)))
def sample_plan(kind: int, knots: Floats, table: Floats, times_s: Floats, point: Any, found: Floats) -> None:
    """Value, rate, acceleration and jerk at each time into `found`, (n, 4); `point` is scratch."""
    for k in range(times_s.size):
        reference_at(kind, knots, table, times_s[k], point)
        found[k, 0], found[k, 1], found[k, 2], found[k, 3] = point.value, point.rate, point.acceleration, point.jerk


def smooth_move(start: Floats, end: Floats, seconds: float) -> Floats:
    """The polynomial of degree seven, (8,), between two points with value and three derivatives, each (4,)."""
    scale = np.array([1.0, 1.0, 2.0, 6.0])
    low = start / scale
    rows = np.array([[_falling(k, d) * (seconds ** (k - d) if k >= d else 0.0) for k in range(8)] for d in range(4)])
    rest = np.linalg.solve(rows[:, 4:], end - rows[:, :4] @ low)
    return np.concatenate([low, rest])


def _falling(k: int, d: int) -> float:
    product = 1.0
    for i in range(d):
        product *= k - i
    return product


def point_to_point(angles_deg: tuple[float, ...] = T1_ANGLES_DEG, move_s: float = T1_MOVE_S, dwell_s: float = T1_DWELL_S) -> Plan:
    """T1: dwells at each angle, joined by moves that are at rest, to the third derivative, at both ends."""
    knots, rows = [0.0], []
    for index, angle in enumerate(angles_deg):
        here = np.array([angle, 0.0, 0.0, 0.0])
        if index:
            rows.append(smooth_move(np.array([angles_deg[index - 1], 0.0, 0.0, 0.0]), here, move_s))
            knots.append(knots[-1] + move_s)
        rows.append(np.concatenate([here[:1], np.zeros(7)]))
        knots.append(knots[-1] + dwell_s)
    return Plan(POLYNOMIALS, np.array(knots), np.array(rows))


def multi_sine(tones_hz: tuple[float, ...], span: tuple[float, float], seconds: float, seed: int) -> Plan:
    """Tones of equal size with phases drawn by `seed`, scaled so that the smallest and largest value are `span`."""
    # RandomState's stream is frozen by numpy's compatibility policy; default_rng's is not.
    phases = np.random.RandomState(seed).uniform(0.0, 2.0 * pi, len(tones_hz))
    omegas = 2.0 * pi * np.array(tones_hz)
    times = np.arange(0.0, seconds, 1e-3)
    raw = np.sin(np.outer(times, omegas) + phases).sum(axis=1)
    scale = (span[1] - span[0]) / (raw.max() - raw.min())
    rows = np.zeros((len(tones_hz) + 1, 8))
    rows[:-1, 0], rows[:-1, 1], rows[:-1, 2] = scale, omegas, phases
    rows[-1, 0] = span[0] - scale * raw.min()
    return Plan(SINES, np.array([0.0, seconds]), rows)


def t2(seed: int) -> Plan:
    """T2: see the constants above."""
    return multi_sine(T2_TONES_HZ, T2_SPAN_DEG, T2_SECONDS, seed)


def excitation(top_hz: float, seed: int, span_kpa: tuple[float, float] = EXCITATION_SPAN_KPA) -> Plan:
    """A pressure trajectory of twenty tones up to `top_hz`, for identification."""
    tones = tuple(top_hz * k / 20.0 for k in range(1, 21))
    return multi_sine(tones, span_kpa, EXCITATION_SECONDS, seed)


def valve_steps(currents_ma: Floats, test_s: float, fill_s: float, empty_s: float, rest_s: float) -> Plan:
    """Currents for flow tests of the valves: above zero the charge valve's, below zero the exhaust valve's; steps, not smooth.

    For each current: rest, charge at it, rest, fill at the highest, rest, exhaust at it, rest, empty at the highest.
    """
    full = float(currents_ma.max())
    values, lengths = [], []
    for current in currents_ma.tolist():
        for value, length in ((current, test_s), (full, fill_s), (-current, test_s), (-full, empty_s)):
            values += [0.0, value]
            lengths += [rest_s, length]
    rows = np.zeros((len(values), 8))
    rows[:, 0] = values
    return Plan(POLYNOMIALS, np.concatenate([[0.0], np.cumsum(lengths)]), rows)


def from_csv(path: Path) -> Plan:
    """A spline of degree seven through the rows `t_s, value` of a CSV file. Raises BadFile."""
    try:
        with warnings.catch_warnings(action="ignore"):  # an empty file: said below in one line
            rows = np.atleast_2d(np.genfromtxt(path, delimiter=",", skip_header=1, usecols=(0, 1)))
    except (OSError, ValueError) as error:
        raise BadFile(f"{path}: not a reference file with a header and columns t_s, value: {error}") from None
    if len(rows) < 8 or not np.all(np.isfinite(rows)) or not np.all(np.diff(rows[:, 0]) > 0):
        raise BadFile(f"{path}: a reference file needs a header and 8 or more rows t_s, value with rising times")
    spline = PPoly.from_spline(make_interp_spline(rows[:, 0] - rows[0, 0], rows[:, 1], k=7))
    inside = np.diff(spline.x) > 0
    return Plan(POLYNOMIALS, np.append(spline.x[:-1][inside], spline.x[-1]), np.ascontiguousarray(spline.c[::-1].T[inside]))
