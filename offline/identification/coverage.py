"""Whether intervals hold what they say, counted over many simulated rigs.

On ideal rigs the model is the rig's own, the true values are known, and a 95 % interval must hold them 95 times in 100.

On rigs with memory, lag and friction no true value of the model exists. There one rig is excited again and again, each time
with another multi-sine: the values scatter, about their own mean. An interval of one experiment is honest when it holds that
mean; an interval for the next experiment, which is wider, when it holds the values of the other experiments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest
from scipy.stats import t as student

from softloop.dynamics.parameters import load_parameters, shipped
from softloop.offline.identification.experiments import FAST, excite, halves
from softloop.offline.identification.fitting import fit_output_error
from softloop.offline.identification.intervals import LEVEL, Uncertainty, of_fit, of_regression
from softloop.offline.identification.regression import instrumental_variables, least_squares
from softloop.offline.identification.series import Series
from softloop.offline.identification.structure import PAPER
from softloop.plant.config import PlantConfig

Floats = NDArray[np.float64]
Progress = Callable[[int, int], None]

IDEAL_METHODS = ("ls white", "ls coloured", "iv coloured", "oe white", "oe coloured")
RIG_METHODS = ("white", "coloured", "bootstrap")
REPEATS = 40
GROUP = 5  # experiments that make one interval by `between`


def true_values() -> Floats:
    """What an ideal rig has, in the order of Eq. 9."""
    bending = load_parameters(shipped()).bending
    return np.array([getattr(bending, name).value for name in PAPER.names])


def count_ideal(seeds: range, progress: Progress) -> dict[str, Any]:
    """Identify ideal rigs, one per seed, and count which intervals hold the true values.

    Returns:
        per method and parameter: `held` (share), `low` and `high` (its 95 % binomial interval), `error_percent` (mean error)
        and `half_percent` (median half width), both relative to the true value.
    """
    truth = true_values()
    found: dict[str, list[Uncertainty]] = {name: [] for name in IDEAL_METHODS}
    for done, seed in enumerate(seeds):
        progress(done, len(seeds))
        data1, _ = halves(excite(FAST, PlantConfig(layer="ideal", seed=seed), seed))
        for name, uncertainty in _all_methods(data1):
            found[name].append(uncertainty)
    progress(len(seeds), len(seeds))
    return {
        "rigs": len(seeds),
        "first_seed": seeds.start,
        "methods": {name: _counted(entries, truth) for name, entries in found.items()},
    }


def _all_methods(data: Series) -> Iterator[tuple[str, Uncertainty]]:
    ls = least_squares(PAPER, data)
    oe = fit_output_error(PAPER, [data])
    iv = instrumental_variables(PAPER, data, oe.values[:-2])
    yield "ls white", of_regression(ls, "white")
    yield "ls coloured", of_regression(ls, "coloured")
    yield "iv coloured", of_regression(iv, "coloured")
    yield "oe white", of_fit(oe, [data], "white")
    yield "oe coloured", of_fit(oe, [data], "coloured")


def _counted(entries: list[Uncertainty], truth: Floats) -> dict[str, dict[str, float]]:
    ends = np.array([entry.interval() for entry in entries])  # (rigs, 2, p)
    values = np.array([entry.values for entry in entries])
    held = (ends[:, 0] <= truth) & (truth <= ends[:, 1])
    out = {}
    for i, name in enumerate(entries[0].names):
        size = abs(float(truth[i]))
        out[name] = _share(int(held[:, i].sum()), len(entries)) | {
            "error_percent": 100.0 * float(values[:, i].mean() - truth[i]) / size,
            "half_percent": 50.0 * float(np.median(ends[:, 1, i] - ends[:, 0, i])) / size,
        }
    return out


def _share(held: int, of: int) -> dict[str, float]:
    exact = binomtest(held, of).proportion_ci(LEVEL, "exact")
    return {"held": held / of, "low": float(exact.low), "high": float(exact.high)}


@dataclass(frozen=True)
class _Repeat:
    values: Floats
    methods: dict[str, Uncertainty]


def count_rig(seeds: range, progress: Progress, repeats: int = REPEATS) -> dict[str, Any]:
    """Excite each rig `repeats` times, each time anew, and count what intervals hold.

    Returns:
        per method and parameter: `mean_held`, the share of the intervals that hold the mean over all repeats; `scatter_held`,
        the share of the other experiments' values that an interval for the next experiment holds; `spread_percent`, the
        standard deviation over repeats, and `error_percent`, the median standard error, relative to the mean.
    """
    rigs = []
    for index, seed in enumerate(seeds):
        found = []
        for repeat in range(repeats):
            progress(index * repeats + repeat, len(seeds) * repeats)
            data1, _ = halves(excite(FAST, PlantConfig(layer="rig", seed=seed), 1000 * seed + repeat))
            fit = fit_output_error(PAPER, [data1])
            found.append(_Repeat(fit.values[:-2], {m: of_fit(fit, [data1], m, repeat + 1) for m in RIG_METHODS}))
        rigs.append(found)
    progress(len(seeds) * repeats, len(seeds) * repeats)
    methods = {m: _held_by_one(rigs, m) for m in RIG_METHODS} | {"between": _held_by_groups(rigs)}
    return {"rigs": len(seeds), "first_seed": seeds.start, "repeats": repeats, "group": GROUP, "methods": methods}


def _held_by_one(rigs: list[list[_Repeat]], method: str) -> dict[str, dict[str, float]]:
    mean_held, scatter_held, errors, spreads = [], [], [], []
    for found in rigs:
        values = np.array([f.values for f in found])
        mean, others = values.mean(axis=0), len(found) - 1
        for f in found:
            low, high = f.methods[method].interval()
            mean_held.append((low <= mean) & (mean <= high))
            half = 0.5 * (high - low) * sqrt(2.0)
            scatter_held.append((np.sum(np.abs(values - f.values) <= half, axis=0) - 1) / others)
            errors.append(f.methods[method].errors / np.abs(mean))
        spreads.append(values.std(axis=0, ddof=1) / np.abs(mean))
    return _table(mean_held, scatter_held, errors, spreads)


def _held_by_groups(rigs: list[list[_Repeat]]) -> dict[str, dict[str, float]]:
    mean_held, scatter_held, errors, spreads = [], [], [], []
    quantile = float(student.ppf(0.5 + 0.5 * LEVEL, GROUP - 1))
    for found in rigs:
        values = np.array([f.values for f in found])
        mean = values.mean(axis=0)
        for first in range(0, len(values) - GROUP + 1, GROUP):
            own = values[first : first + GROUP]
            other = np.delete(values, np.s_[first : first + GROUP], axis=0)
            spread = own.std(axis=0, ddof=1)
            mean_held.append(np.abs(own.mean(axis=0) - mean) <= quantile * spread / sqrt(GROUP))
            half = quantile * spread * sqrt(1.0 + 1.0 / GROUP)
            scatter_held.append(np.mean(np.abs(other - own.mean(axis=0)) <= half, axis=0))
            errors.append(spread / sqrt(GROUP) / np.abs(mean))
        spreads.append(values.std(axis=0, ddof=1) / np.abs(mean))
    return _table(mean_held, scatter_held, errors, spreads)


def _table(mean_held: Any, scatter_held: Any, errors: Any, spreads: Any) -> dict[str, dict[str, float]]:
    columns = (np.mean(mean_held, axis=0), np.mean(scatter_held, axis=0), np.median(errors, axis=0), np.median(spreads, axis=0))
    keys, scale = ("mean_held", "scatter_held", "error_percent", "spread_percent"), (1.0, 1.0, 100.0, 100.0)
    return {
        name: {key: float(s * column[i]) for key, s, column in zip(keys, scale, columns, strict=True)}
        for i, name in enumerate(PAPER.names)
    }
