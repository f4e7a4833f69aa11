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
Step = Callable[[int], None]

IDEAL_METHODS = ("ls white", "ls coloured", "iv coloured", "oe white", "oe coloured")
RIG_METHODS = ("white", "coloured", "bootstrap")
REPEATS = 40
GROUP = 5  # experiments that make one interval by `between`


def true_values() -> Floats:
    """What an ideal rig has, in the order of Eq. 9."""
    bending = load_parameters(shipped()).bending
    return np.array([getattr(bending, name).value for name in PAPER.names])


@dataclass(frozen=True)
class _Held:
    """One method's values (p,), the ends of its intervals and its standard errors."""

    values: Floats
    low: Floats
    high: Floats
    errors: Floats

    @classmethod
    def of(cls, found: Uncertainty) -> _Held:
        low, high = found.interval()
        return cls(found.values, low, high, found.errors)


class IdealTally:
    """Ideal rigs identified so far, one per seed, and which intervals held the true values.

    Attributes:
        steps: of work in each rig.
        block: rigs after which it is worth keeping what was counted.
    """

    steps, block = 1, 10

    def __init__(self) -> None:
        self._rigs: list[dict[str, _Held]] = []

    @property
    def rigs(self) -> int:
        """How many."""
        return len(self._rigs)

    def add(self, seed: int, step: Step) -> None:
        """Identify one more rig by every method."""
        step(0)
        data1, _ = halves(excite(FAST, PlantConfig(layer="ideal", seed=seed), seed))
        self._rigs.append({name: _Held.of(uncertainty) for name, uncertainty in _all_methods(data1)})

    def counted(self) -> dict[str, Any]:
        """Of one or more rigs, per method and parameter.

        Returns:
            `held` (share), `low` and `high` (its 95 % binomial interval), `error_percent` (mean error) and `half_percent` (median
            half width), both relative to the true value.
        """
        truth = true_values()
        methods = {name: _counted([rig[name] for rig in self._rigs], truth) for name in IDEAL_METHODS}
        return {"rigs": self.rigs, "methods": methods}


def _all_methods(data: Series) -> Iterator[tuple[str, Uncertainty]]:
    ls = least_squares(PAPER, data)
    oe = fit_output_error(PAPER, [data])
    iv = instrumental_variables(PAPER, data, oe.values[:-2])
    yield "ls white", of_regression(ls, "white")
    yield "ls coloured", of_regression(ls, "coloured")
    yield "iv coloured", of_regression(iv, "coloured")
    yield "oe white", of_fit(oe, [data], "white")
    yield "oe coloured", of_fit(oe, [data], "coloured")


def _counted(entries: list[_Held], truth: Floats) -> dict[str, dict[str, float]]:
    low, high, values = (np.array([getattr(e, key) for e in entries]) for key in ("low", "high", "values"))
    held = (low <= truth) & (truth <= high)
    out = {}
    for i, name in enumerate(PAPER.names):
        size = abs(float(truth[i]))
        out[name] = _share(int(held[:, i].sum()), len(entries)) | {
            "error_percent": 100.0 * float(values[:, i].mean() - truth[i]) / size,
            "half_percent": 50.0 * float(np.median(high[:, i] - low[:, i])) / size,
        }
    return out


def _share(held: int, of: int) -> dict[str, float]:
    exact = binomtest(held, of).proportion_ci(LEVEL, "exact")
    return {"held": held / of, "low": float(exact.low), "high": float(exact.high)}


@dataclass(frozen=True)
class _Repeat:
    values: Floats
    methods: dict[str, _Held]


class RigTally:
    """Rigs excited `repeats` times each, each time anew, and what intervals held; attributes as `IdealTally`'s."""

    block = 1

    def __init__(self, repeats: int = REPEATS) -> None:
        self.steps = repeats
        self._rigs: list[list[_Repeat]] = []

    @property
    def rigs(self) -> int:
        """How many."""
        return len(self._rigs)

    def add(self, seed: int, step: Step) -> None:
        """Excite one more rig `repeats` times."""
        found = []
        for repeat in range(self.steps):
            step(repeat)
            data1, _ = halves(excite(FAST, PlantConfig(layer="rig", seed=seed), 1000 * seed + repeat))
            fit = fit_output_error(PAPER, [data1])
            found.append(_Repeat(fit.values[:-2], {m: _Held.of(of_fit(fit, [data1], m)) for m in RIG_METHODS}))
        self._rigs.append(found)

    def counted(self) -> dict[str, Any]:
        """Of one or more rigs, per method and parameter.

        Returns:
            `mean_held`, the share of the intervals that hold the mean over all repeats; `scatter_held`, the share of the other
            experiments' values that an interval for the next experiment holds; `spread_percent`, the standard deviation over
            repeats, and `error_percent`, the median standard error, relative to the mean.
        """
        methods = {m: _held_by_one(self._rigs, m) for m in RIG_METHODS} | {"between": _held_by_groups(self._rigs)}
        return {"rigs": self.rigs, "repeats": self.steps, "group": GROUP, "methods": methods}


def _held_by_one(rigs: list[list[_Repeat]], method: str) -> dict[str, dict[str, float]]:
    mean_held, scatter_held, errors, spreads = [], [], [], []
    for found in rigs:
        values = np.array([f.values for f in found])
        mean, others = values.mean(axis=0), len(found) - 1
        for f in found:
            low, high = f.methods[method].low, f.methods[method].high
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
        for first in range(0, len(values) - GROUP + 1, GROUP):
            own = values[first : first + GROUP]
            other = np.delete(values, np.s_[first : first + GROUP], axis=0)
            mean, spread = other.mean(axis=0), own.std(axis=0, ddof=1)  # of the others: its own five would flatter it
            mean_held.append(np.abs(own.mean(axis=0) - mean) <= quantile * spread / sqrt(GROUP))
            half = quantile * spread * sqrt(1.0 + 1.0 / GROUP)
            scatter_held.append(np.mean(np.abs(other - own.mean(axis=0)) <= half, axis=0))
            errors.append(spread / sqrt(GROUP) / np.abs(mean))
        spreads.append(values.std(axis=0, ddof=1) / np.abs(values.mean(axis=0)))
    return _table(mean_held, scatter_held, errors, spreads)


def _table(mean_held: Any, scatter_held: Any, errors: Any, spreads: Any) -> dict[str, dict[str, float]]:
    columns = (np.mean(mean_held, axis=0), np.mean(scatter_held, axis=0), np.median(errors, axis=0), np.median(spreads, axis=0))
    keys, scale = ("mean_held", "scatter_held", "error_percent", "spread_percent"), (1.0, 1.0, 100.0, 100.0)
    return {
        name: {key: float(s * column[i]) for key, s, column in zip(keys, scale, columns, strict=True)}
        for i, name in enumerate(PAPER.names)
    }
