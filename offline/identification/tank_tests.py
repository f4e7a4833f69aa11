"""Steady flows of both valves from the log of an experiment on a tank: charge and discharge, as ISO 6358 has it.

While a current stands, the pressure of an isothermal tank of known volume rises or falls with the flow: Q = V / (R T) dP/dt
(Eq. 11). A window of WINDOW_S gives one test: the slope of a straight line through its pressures, the mean pressures on both
sides, and the mean current that the driver measured. Without a known volume the same windows give Q / V.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from softloop.dynamics.gas import GAS_CONSTANT, PA_PER_KPA
from softloop.offline import metrics
from softloop.offline.identification.intervals import Uncertainty, information_rank
from softloop.offline.identification.valve_flow import (
    NAMES,
    RANK_TOLERANCE,
    SCALE,
    STEP,
    FlowTests,
    ValveFit,
    fit_valve,
    modelled,
)
from softloop.offline.log import Log, Records
from softloop.wire.errors import BadFile

Floats = NDArray[np.float64]
VALVES = ("charge", "exhaust")
LEAST_SAMPLES = 8
LEAST_KPA = 20.0  # across a valve: below it a sensor's zero is too large a part of it
# Of NAMES, those whose unit has the flow's size in it: an error of the volume is an error of them.
WITH_VOLUME = np.array([1.0, 0.0, 1.0, 1.0, 0.0])


@dataclass(frozen=True)
class Windows:
    """How a test is cut: what is left out after a step of the current, and the length of a window, s."""

    settle_s: float = 0.3
    window_s: float = 0.5


@dataclass(frozen=True)
class Volume:
    """What the gas goes into: m3, its relative standard error, and the gas's temperature."""

    volume_m3: float
    error: float = 0.0
    temperature_k: float = 293.15

    def flow_kg_s(self, slope_kpa_s: float) -> float:
        return PA_PER_KPA * slope_kpa_s * self.volume_m3 / (GAS_CONSTANT * self.temperature_k)


def flow_tests(log: Log, volume: Volume, windows: Windows = Windows()) -> dict[str, FlowTests]:
    """Tests of the charge and of the exhaust valve. Raises BadFile when the log holds no such experiment."""
    rows: dict[str, list[tuple[float, float, float, float]]] = {name: [] for name in VALVES}
    for charging, start_ns, end_ns in _steps(log):
        first = start_ns + round(1e9 * windows.settle_s)
        for a, b in pairwise(np.arange(first, end_ns + 1, round(1e9 * windows.window_s)).tolist()):
            row = _row(log, charging, a, b, volume)
            if row is not None:
                rows[VALVES[0 if charging else 1]].append(row)
    if not any(rows.values()):
        raise BadFile(f"{log.path}: no flow test is in this log; `softloop experiment valves` makes them")
    return {name: _as_tests(found) for name, found in rows.items()}


def joined(parts: list[FlowTests]) -> FlowTests:
    """Tests of several logs as one."""
    return FlowTests(*(np.concatenate([getattr(p, name) for p in parts]) for name in FlowTests.__dataclass_fields__))


def _as_tests(rows: list[tuple[float, float, float, float]]) -> FlowTests:
    columns = np.array(rows, np.float64).reshape(-1, 4).T
    return FlowTests(*(np.ascontiguousarray(c) for c in columns))


def _steps(log: Log) -> list[tuple[bool, int, int]]:
    """Whether it charges, start and end (ns) of each stretch of the trajectory with one current of one valve."""
    track = metrics.tracked(log)
    asked = track["charge_current_ma"] - track["exhaust_current_ma"]
    ends = np.flatnonzero(np.diff(asked)) + 1
    edges = [0, *ends.tolist(), len(asked)] if len(asked) else [0]
    stamps = track["stamp_ns"]
    return [(bool(asked[a] > 0.0), int(stamps[a]), int(stamps[b - 1])) for a, b in pairwise(edges) if asked[a] != 0.0]


def span_s(log: Log) -> tuple[float, float]:
    """From the first current to the end of the last one, s from the run's first tick."""
    steps, first_ns = _steps(log), int(log["cycle"]["stamp_ns"][0])
    return 1e-9 * (steps[0][1] - first_ns), 1e-9 * (steps[-1][2] - first_ns)


def _row(log: Log, charging: bool, start_ns: int, end_ns: int, volume: Volume) -> tuple[float, float, float, float] | None:
    """Current, upstream and downstream pressure and flow of one window; None where it says nothing."""
    samples, words = _within(log["pressure"], start_ns, end_ns), _within(log["valves"], start_ns, end_ns)
    if len(samples) < LEAST_SAMPLES or not len(words):
        return None
    time_s = 1e-9 * (samples["stamp_ns"] - start_ns)
    slope = float(np.polyfit(time_s, samples["chamber_pressure_kpa"], 1)[0])
    chamber, supply = float(samples["chamber_pressure_kpa"].mean()), float(samples["supply_pressure_kpa"].mean())
    up, down = (supply, chamber) if charging else (chamber, 0.0)
    if up - down < LEAST_KPA:
        return None
    valve = "charge" if charging else "exhaust"
    measured, sent = words[f"{valve}_coil_ma"], words[f"{valve}_current_ma"]
    current = float(np.where(np.isfinite(measured), measured, sent).mean())  # not every driver measures
    return current, up, down, volume.flow_kg_s(slope if charging else -slope)


def _within(records: Records, start_ns: int, end_ns: int) -> Records:
    first, last = np.searchsorted(records["stamp_ns"], [start_ns, end_ns])
    return records[first:last]


def fit_on_tank(tests: FlowTests, volume: Volume, discharge: float) -> ValveFit:
    """The valve's numbers, with the error of the tank's volume in every interval that it bears on. Raises BadFile."""
    found = fit_valve(tests, discharge, volume.temperature_k)
    sure = found.uncertainty
    if sure is None:
        return found
    share = shared_error(sure, volume)
    return replace(found, uncertainty=replace(sure, covariance=sure.covariance + np.outer(share, share)))


def shared_error(sure: Uncertainty, volume: Volume) -> Floats:
    """One standard error of the tank's volume, in each of a valve's numbers."""
    return np.asarray(volume.error * sure.values * WITH_VOLUME[[NAMES.index(n) for n in sure.names]], np.float64)


@dataclass(frozen=True)
class Ratios:
    """What a rig's own pressure shows of a valve: numbers over the unknown volume V.

    Attributes:
        names: of `sure`, such as `k_v1_m2_ma / V` (per m3) and `k_v2_pa`, which has no volume in it.
        sure: their values and covariance; None where none is shown.
        rank: of the information matrix of the five numbers and V, of 6.
        fit: NRMSE fit of the flow, %.
    """

    names: tuple[str, ...]
    sure: Uncertainty | None
    rank: int
    fit: float


def fit_ratios(tests: FlowTests, nominal: Volume, discharge: float) -> Ratios:
    """Fit with a nominal volume, and give only what does not depend on it. Raises BadFile."""
    found = fit_valve(tests, discharge, nominal.temperature_k)
    rank = _rank_with_volume(found, tests, nominal, discharge)
    sure = found.uncertainty
    if sure is None:
        return Ratios((), None, rank, found.fit)
    over = np.array([nominal.volume_m3 if WITH_VOLUME[NAMES.index(n)] else 1.0 for n in sure.names])
    names = tuple(f"{n} / V" if WITH_VOLUME[NAMES.index(n)] else n for n in sure.names)
    scaled = replace(sure, names=names, values=sure.values / over, covariance=sure.covariance / np.outer(over, over))
    return Ratios(names, scaled, rank, found.fit)


def _rank_with_volume(found: ValveFit, tests: FlowTests, nominal: Volume, discharge: float) -> int:
    """Rank of the derivatives of dP/dt = R T Q / V by the five numbers and by V."""
    size, base = float(tests.flow_kg_s.max()), modelled(found.values, tests, discharge, nominal.temperature_k)
    columns = []
    for place in range(len(NAMES)):
        moved = found.values.copy()
        moved[place] += STEP * SCALE[place]
        columns.append((modelled(moved, tests, discharge, nominal.temperature_k) - base) / (STEP * size))
    columns.append(-base / size)  # by V, relative
    return information_rank(np.column_stack(columns), RANK_TOLERANCE)[0]
