"""The way to a good fit: a start that needs no other, then output error in steps of growing structures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from softloop.offline.identification.output_error import Fit, Problem, first_states, solve
from softloop.offline.identification.regression import as_fit, least_squares, low_pass
from softloop.offline.identification.series import Series
from softloop.offline.identification.structure import Structure, bare_of, carry_over
from softloop.wire.errors import BadConfig

Floats = NDArray[np.float64]

GOOD_START = 95.0  # %, a regression that simulates as well as this needs no rival
_CUTOFFS_RAD_S = (20.0, 10.0, 40.0, 5.0)
_START_OMEGA = (1.0, 3.0, 8.0, 20.0)  # rad/s
_START_DAMPING = (0.7, 3.0)  # relative
_CREEP_FASTEST_1_S = 1.0


def start_linear(experiments: Sequence[Series]) -> Fit:
    """The best of a few linear models with the static gain of the data, then fitted."""
    structure = Structure(m=0, n=0, r=0, inputs=experiments[0].pressure_kpa.shape[1])
    problem, starts = Problem(structure, experiments), first_states(experiments)
    pressure = np.concatenate([e.pressure_kpa[e.counted] for e in experiments])
    angle = np.concatenate([e.angle_deg[e.counted] for e in experiments])
    gain = np.linalg.lstsq(np.column_stack([pressure, np.ones(len(angle))]), angle, rcond=None)[0]
    tried = []
    for omega in _START_OMEGA:
        for damping in _START_DAMPING:
            values = np.concatenate([[omega**2], omega**2 * gain[:-1], [2.0 * damping * omega, omega**2 * gain[-1], 0.0, 0.0]])
            unknowns = problem.pack(values, starts)
            tried.append((float(np.sum(problem.residuals(unknowns, values) ** 2)), values))
    best = min(tried, key=lambda t: t[0])[1]
    return solve(problem, best, starts)


def start(structure: Structure, experiments: Sequence[Series]) -> Fit:
    """The better of the paper's least squares, over a few filters, and the linear model."""
    bare, found = bare_of(structure), []
    for cutoff in _CUTOFFS_RAD_S:
        if cutoff * experiments[0].sample_s > 1.0:  # the filter would see samples, not signals
            continue
        try:
            found.append(as_fit(least_squares(bare, experiments[0], low_pass(cutoff)), experiments[0]))
        except BadConfig:
            continue
        if found[-1].fits[0] > GOOD_START:
            break
    best = max(found, key=lambda f: f.fits[0], default=None)
    if best is not None:
        best = replace(best, starts=first_states(experiments))
    if best is not None and best.fits[0] > GOOD_START:
        return best
    linear = start_linear(experiments)
    return best if best is not None and best.fits[0] > linear.fits[0] else linear


def fit_output_error(structure: Structure, experiments: Sequence[Series], begin: Fit | None = None, iterations: int = 60) -> Fit:
    """Fit a structure to experiments, in steps: the orders, then memory, then delay and lag.

    Args:
        structure: what to fit.
        experiments: training data; all count alike per sample.
        begin: a fit of a smaller structure (or the same) to begin from.
        iterations: how often the solver may look, in each step.
    """
    fit = begin or start(structure, experiments)
    for step in _steps(fit.structure, structure):
        problem = Problem(step, experiments)
        values = carry_over(fit.values, fit.structure, step)
        _begin_memory(values, fit.structure, step, problem)
        fit = solve(problem, values, fit.starts, iterations)
    return fit


def _steps(old: Structure, new: Structure) -> list[Structure]:
    """Structures on the way from `old` to `new`, the last of them `new`."""
    bare = replace(bare_of(new), at_rest=new.at_rest)
    memory = replace(bare, hysteresis=new.hysteresis, creep=new.creep)
    way = [s for s in (bare, memory) if set(s.names) > set(old.names)]
    return [s for i, s in enumerate(way) if s not in way[:i] and s != new] + [new]


def _begin_memory(values: Floats, old: Structure, new: Structure, problem: Problem) -> None:
    """Small first guesses for memory that is new: widths and rates spread over range and length."""
    stiffness = abs(float(np.mean(np.polynomial.polynomial.polyval(problem.grid, values[new.terms("a")]))))
    length = max(float(e.time_s[-1] - e.time_s[0]) for e in problem.experiments)
    if new.hysteresis > old.hysteresis:
        values[new.terms("w")] = problem.spread * np.geomspace(1.0, 0.1, new.hysteresis)
        values[new.terms("h")] = 0.05 * stiffness * problem.spread / new.hysteresis
    if new.creep > old.creep:
        values[new.terms("rate")] = np.geomspace(10.0 / length, _CREEP_FASTEST_1_S, new.creep + 1)[:-1]
        values[new.terms("k")] = 0.05 * stiffness / new.creep
