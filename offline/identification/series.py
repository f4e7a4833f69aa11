"""Measured pressure and angle over time, and how well a simulated angle fits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softloop.controller.records import CYCLE
from softloop.offline.log import Log
from softloop.wire.errors import BadFile
from softloop.wire.messages import constant

Floats = NDArray[np.float64]
_APPROACH, _TRACK = constant("CycleRecord", "PHASE_APPROACH"), constant("CycleRecord", "PHASE_TRACK")
SETTLE_S = 2.0  # at the start of the trajectory: the move to its first point has died out
LEAST_SAMPLES = 50
LEAD_RANGE = 0.15
UNEVEN = 0.1  # part of a step by which its neighbours may differ from it
_FOUR = (-1, 0, 1, 2)


@dataclass(frozen=True)
class Series:
    """One experiment.

    A simulation runs from the first sample; only what lies in the window counts in a fit. So memory starts where the actuator
    was at rest, and the second half of a run can be scored with the first half's past.

    Attributes:
        name: what to call it.
        time_s: (n,), rising; the instants at which the angle was measured.
        pressure_kpa: (n, inputs), brought to those instants.
        angle_deg: (n,).
        window_s: start and end of what counts.
    """

    name: str
    time_s: Floats
    pressure_kpa: Floats
    angle_deg: Floats
    window_s: tuple[float, float] = (-np.inf, np.inf)

    def __post_init__(self) -> None:
        for name in ("time_s", "pressure_kpa", "angle_deg"):  # as kernels take them
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), np.float64))

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Which samples count, (n,)."""
        return (self.time_s >= self.window_s[0]) & (self.time_s <= self.window_s[1])

    @property
    def sample_s(self) -> float:
        """The usual interval."""
        return float(np.median(np.diff(self.time_s)))

    def part(self, name: str, first: float, last: float) -> Series:
        """The same experiment, counted between two shares of its window."""
        counted = self.time_s[self.counted]
        start, length = float(counted[0]), float(counted[-1] - counted[0])
        # What one part counts the next does not, so that halves share no sample.
        end = start + last * length - (0.5 * self.sample_s if last < 1.0 else 0.0)
        until = self.time_s <= end + 1e-12
        window = (start + first * length, end)
        return Series(name, self.time_s[until], self.pressure_kpa[until], self.angle_deg[until], window)

    def uniform(self) -> Series:
        """The counted part on an even grid, straight between samples: what filters need."""
        counted = self.counted
        time_s = self.time_s[counted]
        grid = np.arange(time_s[0], time_s[-1], self.sample_s)
        columns = [np.interp(grid, time_s, column) for column in self.pressure_kpa[counted].T]
        return Series(self.name, grid, np.stack(columns, axis=1), np.interp(grid, time_s, self.angle_deg[counted]))


def nrmse_fit(measured: Floats, simulated: Floats) -> float:
    """The paper's fit, %: 100 (1 - |y - y_sim| / |y - mean(y)|). 100 is perfect, 0 no better than the mean."""
    return float(100.0 * (1.0 - np.linalg.norm(measured - simulated) / np.linalg.norm(measured - measured.mean())))


def from_samples(name: str, pressure: Any, inclination: Any, window_s: tuple[float, float], start_ns: int) -> Series:
    """A series from two streams with clocks of their own; both have `stamp_ns`.

    The pressure is taken between its samples at the instants of the angle, so that no sample of the angle is touched.
    """
    _, once = np.unique(inclination["stamp_ns"], return_index=True)
    inclination = inclination[once]
    _, once = np.unique(pressure["stamp_ns"], return_index=True)
    pressure = pressure[once]
    inside = inclination["stamp_ns"] >= start_ns
    if len(pressure):
        inside &= (inclination["stamp_ns"] >= pressure["stamp_ns"][0]) & (inclination["stamp_ns"] <= pressure["stamp_ns"][-1])
    inclination = inclination[inside]
    if len(inclination) < LEAST_SAMPLES:
        raise BadFile(f"{name}: {len(inclination)} samples of angle with pressure; identification needs {LEAST_SAMPLES} or more")
    time_s = (inclination["stamp_ns"] - start_ns) * 1e-9
    at_s = (pressure["stamp_ns"] - start_ns) * 1e-9
    chamber = between_samples(time_s, at_s, pressure["chamber_pressure_kpa"])
    angle = np.unwrap(inclination["angle_deg"], period=360.0)
    begin = _lead_in(time_s, angle, window_s)
    return Series(name, time_s[begin:], chamber[begin:, None], angle[begin:], window_s)


def between_samples(time_s: Floats, at_s: Floats, values: Floats) -> Floats:
    """`values` (n,), sampled at `at_s` (n,), at the times `time_s` (k,) among them.

    A chord lies always on the inner side of its arc, which would make b(y) smaller than it is. So it is a cubic through four
    samples; where these are not even, because one was lost or came late, straight between two.
    """
    straight = np.interp(time_s, at_s, values)
    if len(at_s) < len(_FOUR):
        return straight
    j = np.clip(np.searchsorted(at_s, time_s, "right") - 1, 1, len(at_s) - 3)
    steps = np.stack([at_s[j + k + 1] - at_s[j + k] for k in _FOUR[:-1]])
    u = (time_s - at_s[j]) / steps[1]
    weights = (-u * (u - 1) * (u - 2) / 6, (u + 1) * (u - 1) * (u - 2) / 2, -(u + 1) * u * (u - 2) / 2, (u + 1) * u * (u - 1) / 6)
    even = np.abs(steps - steps[1]).max(axis=0) <= UNEVEN * steps[1]
    curved = sum(w * values[j + k] for w, k in zip(weights, _FOUR, strict=True))
    return np.asarray(np.where(even & (u >= 0.0) & (u <= 1.0), curved, straight), np.float64)


def _lead_in(time_s: Floats, angle_deg: Floats, window_s: tuple[float, float]) -> int:
    """From where a simulation may start: before it the angle was far outside the window's range, where no model is fitted."""
    inside = angle_deg[(time_s >= window_s[0]) & (time_s <= window_s[1])]
    if not len(inside):
        return 0
    margin = LEAD_RANGE * np.ptp(inside)
    outside = (angle_deg < inside.min() - margin) | (angle_deg > inside.max() + margin)
    before = np.flatnonzero(outside & (time_s < window_s[0]))
    return int(before[-1]) + 1 if len(before) else 0


def from_cycles(cycles: Any, name: str = "run") -> Series:
    """The series of a simulated run, from its cycle records (n,). The window begins SETTLE_S into the trajectory."""
    phase, stamps = cycles["phase"], cycles["stamp_ns"]
    on_way = cycles[(phase == _APPROACH) | (phase == _TRACK)]
    track = stamps[phase == _TRACK]
    if not len(track):
        raise BadFile(f"{name}: the log holds no trajectory")
    start, window = int(on_way["stamp_ns"][0]), (int(track[0]), int(track[-1]))
    seconds = tuple((w - start) * 1e-9 for w in window)
    return from_samples(name, _view(on_way, "pressure"), _view(on_way, "inclination"), (seconds[0] + SETTLE_S, seconds[1]), start)


def from_log(log: Log, name: str) -> Series:
    """The series of a logged run: all samples of both sensors, the trajectory as window. Raises BadFile."""
    cycles = log["cycle"] if "cycle" in log.channels else np.zeros(0, CYCLE)
    track = cycles["stamp_ns"][cycles["phase"] == _TRACK]
    if not len(track):
        raise BadFile(f"{name}: the log holds no trajectory")
    on_way = cycles["stamp_ns"][(cycles["phase"] == _APPROACH) | (cycles["phase"] == _TRACK)]
    start = int(on_way[0])
    window = ((int(track[0]) - start) * 1e-9 + SETTLE_S, (int(track[-1]) - start) * 1e-9)
    last = int(track[-1])
    streams = [log[c][log[c]["stamp_ns"] <= last] for c in ("pressure", "inclination")]
    return from_samples(name, streams[0], streams[1], window, start)


def _view(cycles: Any, stream: str) -> Any:
    """What the controller saw of one stream, under the names that the stream itself has."""
    value = {"pressure": "chamber_pressure_kpa", "inclination": "angle_deg"}[stream]
    out = np.zeros(len(cycles), [("stamp_ns", "i8"), (value, "f8")])
    out["stamp_ns"], out[value] = cycles[f"{stream}_stamp_ns"], cycles[value]
    return out
