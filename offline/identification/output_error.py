"""Output error: the parameters whose free simulation comes nearest to the measured angle.

Unconstrained, a polynomial of the angle is free to turn negative where there was little data, and the model explodes on the
next run. So a(y), c(y) and the static stiffness d(a(y) y)/dy are held above small bounds on the range of the data and some way
beyond it; a damping faster than the sampling, which no data can show, is held below the sampling rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from softloop.offline.identification.series import Series, nrmse_fit
from softloop.offline.identification.simulator import simulate, simulate_all
from softloop.offline.identification.structure import Structure, d_at_rest

Floats = NDArray[np.float64]

STEP = 1e-6  # of each parameter's scale, for derivatives
BEYOND = 0.15  # of the range, on either side, on which the bounds hold too
GRID = 24
STILL, FIRST_SAMPLES = 0.02, 5
DAMPING_LEAST_1_S, STIFFNESS_LEAST_1_S2 = 0.3, 1.0


@dataclass(frozen=True)
class Fit:
    """A fitted model.

    Attributes:
        structure: what it is made of.
        values: (structure.size,), the first state of the first experiment last.
        starts: (experiments, 2), the first states.
        fits: NRMSE fit of each training experiment, %.
        evaluations: how often the solver asked for residuals.
    """

    structure: Structure
    values: Floats
    starts: Floats
    fits: tuple[float, ...]
    evaluations: int = 0

    def named(self) -> dict[str, float]:
        """Name -> value."""
        return dict(zip(self.structure.names, self.values[:-2].tolist(), strict=True))


class Problem:
    """Residuals and their derivatives of one or more experiments under one structure.

    The unknowns are the shared parameters and two first states for each experiment, each divided by its scale.
    """

    def __init__(self, structure: Structure, experiments: Sequence[Series], free: NDArray[np.bool_] | None = None) -> None:
        self.structure, self.experiments = structure, list(experiments)
        angles = np.concatenate([e.angle_deg[e.counted] for e in experiments])
        pressures = np.concatenate([np.abs(e.pressure_kpa).max(axis=0) for e in experiments])
        self.angle_deg = float(np.abs(angles).max())
        self.scale = structure.scales(self.angle_deg, float(pressures.max()))
        self.spread = float(angles.std())
        low, high = float(angles.min()), float(angles.max())
        self.grid = np.linspace(low - BEYOND * (high - low), high + BEYOND * (high - low), GRID)
        self.damping_most_1_s = 1.0 / min(e.sample_s for e in experiments)
        self.shared = structure.size - 2
        self.free = np.ones(self.shared, np.bool_) if free is None else free.copy()
        if structure.at_rest:
            self.free[structure.place("d")] = False
        self.counted = [e.counted for e in experiments]
        self._begun = [_beginning(e) for e in experiments]
        self._seen: tuple[bytes, list[Floats]] = (b"", [])

    def substeps(self, values: Floats) -> int:
        """RK4 steps per sample: enough for the fastest damping on the range."""
        damping = np.abs(np.polynomial.polynomial.polyval(self.grid, values[self.structure.terms("c")])).max()
        sample_s = max(e.sample_s for e in self.experiments)
        return int(min(max(ceil(sample_s * damping / 1.2), 1, ceil(sample_s / 0.02)), 50))

    def pack(self, values: Floats, starts: Floats) -> Floats:
        """Unknowns from parameters (size,) and first states (experiments, 2)."""
        shared = (values[:-2] / self.scale[:-2])[self.free]
        return np.concatenate([shared, (starts / self.scale[-2:]).ravel()])

    def unpack(self, unknowns: Floats, fixed: Floats) -> tuple[Floats, Floats]:
        """The reverse of `pack`; what is not free is taken from `fixed` (size,)."""
        values, count = fixed.copy(), int(self.free.sum())
        values[:-2][self.free] = unknowns[:count] * self.scale[:-2][self.free]
        starts = unknowns[count:].reshape(-1, 2) * self.scale[-2:]
        values[-2:] = starts[0]
        if self.structure.at_rest:
            values[self.structure.place("d")] = d_at_rest(self.structure, values, self.experiments[0].pressure_kpa[0])
        return values, starts

    def simulated(self, values: Floats, starts: Floats) -> list[Floats]:
        """The angle of each experiment, (n,) each."""
        out = []
        for experiment, start in zip(self.experiments, starts, strict=True):
            p = np.concatenate([values[:-2], start])
            angle = np.empty(len(experiment.time_s))
            steps = self.substeps(values)
            simulate(p, self.structure.layout, experiment.time_s, experiment.pressure_kpa, steps, angle)
            out.append(angle)
        return out

    def residuals(self, unknowns: Floats, fixed: Floats) -> Floats:
        """Simulated less measured where it counts, deg, then the bounds, then first states less measured ones.

        Memory would take up whatever a first state long before the window leaves in it; the next run has no such state.
        """
        values, starts = self.unpack(unknowns, fixed)
        angles = self.simulated(values, starts)
        self._seen = (unknowns.tobytes(), angles)
        parts = [(a - e.angle_deg)[c] for a, e, c in zip(angles, self.experiments, self.counted, strict=True)]
        first = [(start - b.state) * b.weight for start, b in zip(starts, self._begun, strict=True)]
        return np.concatenate([*parts, self.bounds(values), *first])

    def bounds(self, values: Floats) -> Floats:
        """How far a, c and the static stiffness are outside their bounds on the grid; 0 inside. In deg, so that they weigh."""
        poly = np.polynomial.polynomial.polyval
        a, c = values[self.structure.terms("a")], values[self.structure.terms("c")]
        stiffness = poly(self.grid, a * np.arange(1, len(a) + 1))
        damping = poly(self.grid, c)
        least, size = STIFFNESS_LEAST_1_S2, self.scale[0]
        missing = [(least - stiffness) / size, (least - poly(self.grid, a)) / size]
        missing.append((DAMPING_LEAST_1_S - damping) / self.scale[self.structure.terms("c")][0])
        missing.append((damping - self.damping_most_1_s) / self.damping_most_1_s)
        weight = self.spread * np.sqrt(sum(int(c.sum()) for c in self.counted) / GRID)
        return weight * np.concatenate([np.maximum(m, 0.0) for m in missing])

    def jacobian(self, unknowns: Floats, fixed: Floats) -> Floats:
        """Derivatives of `residuals`, forward differences, (residuals, unknowns)."""
        values, starts = self.unpack(unknowns, fixed)
        if self._seen[0] != unknowns.tobytes():
            self.residuals(unknowns, fixed)
        centre, places = self._seen[1], np.flatnonzero(self.free)
        rows = [np.zeros((int(c.sum()), len(unknowns))) for c in self.counted]
        for index, experiment in enumerate(self.experiments):
            moved, columns = self._moved(values, starts[index], places, index)
            out = np.empty((len(moved), len(experiment.time_s)))
            steps = self.substeps(values)
            simulate_all(moved, self.structure.layout, experiment.time_s, experiment.pressure_kpa, steps, out)
            out -= centre[index]
            rows[index][:, columns] = out[:, self.counted[index]].T / STEP
        first = np.zeros((starts.size, len(unknowns)))
        first[:, len(places) :] = np.diag(np.concatenate([self.scale[-2:] * b.weight for b in self._begun]))
        return np.vstack([*rows, self._bounds_jacobian(values, places, len(unknowns)), first])

    def _moved(self, values: Floats, start: Floats, places: NDArray[np.int64], index: int) -> tuple[Floats, list[int]]:
        """Parameter rows, one step away in each unknown that touches this experiment, and which unknowns those are."""
        p = np.concatenate([values[:-2], start])
        own = [len(places) + 2 * index, len(places) + 2 * index + 1]
        at = [*places.tolist(), len(p) - 2, len(p) - 1]
        moved = np.tile(p, (len(at), 1))
        moved[np.arange(len(at)), at] += STEP * self.scale[at]
        return moved, [*range(len(places)), *own]

    def _bounds_jacobian(self, values: Floats, places: NDArray[np.int64], unknowns: int) -> Floats:
        centre = self.bounds(values)
        out = np.zeros((len(centre), unknowns))
        for column, place in enumerate(places):
            moved = values.copy()
            moved[place] += STEP * self.scale[place]
            out[:, column] = (self.bounds(moved) - centre) / STEP
        return out

    def limits(self) -> tuple[Floats, Floats]:
        """Lower and upper limits of the unknowns: memory only takes energy away, times are positive."""
        low, high = np.full(self.structure.size, -np.inf), np.full(self.structure.size, np.inf)
        s, length = self.structure, max(float(e.time_s[-1] - e.time_s[0]) for e in self.experiments)
        low[s.terms("h")], low[s.terms("k")] = 0.0, 0.0
        low[s.terms("w")], high[s.terms("w")] = 1e-3 * self.angle_deg, 2.0 * self.angle_deg
        low[s.terms("rate")], high[s.terms("rate")] = 0.5 / length, 20.0
        if s.delay:
            low[s.place("delay_s")], high[s.place("delay_s")] = -0.5, 0.5
        if s.lag:
            low[s.place("lag_s")], high[s.place("lag_s")] = 0.0, 1.0
        starts = np.full(2 * len(self.experiments), np.inf)
        if s.at_rest:
            starts[1::2] = 1e-6
        shared = [(x / self.scale)[:-2][self.free] for x in (low, high)]
        return np.concatenate([shared[0], -starts]), np.concatenate([shared[1], starts])


def solve(problem: Problem, values: Floats, starts: Floats, iterations: int = 60, tolerance: float = 1e-6) -> Fit:
    """Least squares from a start; where the solver ends is what it gives, however good."""
    low, high = problem.limits()
    begin = np.clip(problem.pack(values, starts), low + 1e-9, high - 1e-9)
    found = least_squares(
        problem.residuals, begin, problem.jacobian, (low, high), "trf", tolerance, tolerance, tolerance,
        x_scale="jac", max_nfev=iterations, args=(values,),
    )  # fmt: skip
    fitted, first = problem.unpack(found.x, values)
    angles = problem.simulated(fitted, first)
    fits = [nrmse_fit(e.angle_deg[c], a[c]) for a, e, c in zip(angles, problem.experiments, problem.counted, strict=True)]
    return Fit(problem.structure, fitted, first, tuple(fits), int(found.nfev))


@dataclass(frozen=True)
class _Beginning:
    """Angle and rate (2,) that the first samples show, and the weights (2,) of those among them that do not count."""

    state: Floats
    weight: Floats


def first_states(experiments: Sequence[Series]) -> Floats:
    """Angle and rate at the start of each experiment, (experiments, 2).

    At rest, the mean angle before a pressure moves; a series that begins in motion gets a line through its first samples.
    """
    return np.array([_beginning(e).state for e in experiments])


def _beginning(experiment: Series) -> _Beginning:
    moved = np.abs(experiment.pressure_kpa - experiment.pressure_kpa[0]) > STILL * np.ptp(experiment.pressure_kpa, axis=0)
    still = int(np.argmax(moved.any(axis=1))) if moved.any() else len(moved)
    count = max(still, FIRST_SAMPLES)
    time_s, angle = experiment.time_s[:count] - experiment.time_s[0], experiment.angle_deg[:count]
    alone = ~experiment.counted[:count]  # the others are compared with the simulation as it is
    weight = np.sqrt([alone.sum(), np.sum((time_s[alone] - time_s.mean()) ** 2)])
    if still > FIRST_SAMPLES:
        return _Beginning(np.array([np.mean(angle), 0.0]), weight)
    rate, level = np.polyfit(time_s, angle, 1)
    return _Beginning(np.array([level, rate]), weight)


def free_run(fit: Fit, experiment: Series) -> Floats:
    """The model's angle over an experiment from its pressures and its first measured angle alone, (n,)."""
    start = first_states([experiment])[0]
    problem = Problem(fit.structure, [experiment])
    return problem.simulated(np.concatenate([fit.values[:-2], start]), start[None, :])[0]


def score(fit: Fit, experiment: Series) -> float:
    """NRMSE fit of a free run, %."""
    counted = experiment.counted
    return nrmse_fit(experiment.angle_deg[counted], free_run(fit, experiment)[counted])
