"""The identification of the paper's section 2.1 from two logged experiments, and past it: every model, and what it scores."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softloop.dynamics.parameters import load_parameters, shipped
from softloop.offline.identification.experiments import FAST, excite, halves
from softloop.offline.identification.fitting import fit_output_error
from softloop.offline.identification.intervals import Uncertainty, of_fit, of_regression
from softloop.offline.identification.output_error import Fit, score
from softloop.offline.identification.regression import as_fit, instrumental_variables, least_squares
from softloop.offline.identification.series import Series, from_log
from softloop.offline.identification.structure import LINEAR, PAPER, Structure
from softloop.offline.run_log import open_run
from softloop.plant.config import PlantConfig
from softloop.wire.errors import BadConfig

SLOW = "excitation_05hz"
PAPER_FITS = {"Data2": 92.8772, "Data3": 90.8123}  # NRMSE fit, %, as printed in section 2.1
MEMORY = Structure(hysteresis=1, creep=2)  # the structure that is recommended where an actuator remembers
DATA = ("Data1", "Data2", "Data3")
Progress = Callable[[int, int], None]
_WORDS = ("no", "one", "two", "three", "four")


def words_of(memory: Structure) -> str:
    """How much a structure remembers, in words."""
    counts = ((memory.hysteresis, "Bouc-Wen element"), (memory.creep, "creep term"))
    return " and ".join(f"{_WORDS[n] if n < len(_WORDS) else n} {what}{'s' * (n != 1)}" for n, what in counts)


@dataclass(frozen=True)
class Model:
    """One way to identify, and what it came to.

    Attributes:
        key, words: its short name, and what it is.
        fit: the model.
        sure: how sure its values are; None where that is not asked.
        scores: NRMSE fit of a free simulation of Data1 (trained), Data2 and Data3, %.
    """

    key: str
    words: str
    fit: Fit
    sure: Uncertainty | None
    scores: dict[str, float]


@dataclass(frozen=True)
class Identified:
    """All models of one pair of experiments; `series` are Data1 to Data3."""

    series: tuple[Series, Series, Series]
    models: tuple[Model, ...]
    left_out: tuple[str, ...]

    def model(self, key: str) -> Model:
        return next(m for m in self.models if m.key == key)


def data_of(fast: Path, slow: Path) -> tuple[Series, Series, Series]:
    """Data1, Data2 and Data3 from the runs of the two multi-sines. Raises BadFile."""
    first, second = halves(from_log(open_run(fast), "Data1"))
    third = from_log(open_run(slow), "Data3")
    return first, second, third


def identify_all(series: tuple[Series, Series, Series], progress: Progress, only: str = "") -> Identified:
    """Every model (or the one of the key `only`), trained on Data1. A method that finds no model is left out with a word."""
    found: list[Model] = []
    left_out: list[str] = []
    methods = [m for m in _METHODS if only in ("", m[0])]
    for done, (key, words, make) in enumerate(methods):
        progress(done, len(methods))
        try:
            fit, sure = make(series[0])
        except (BadConfig, np.linalg.LinAlgError) as error:
            left_out.append(f"{words}: {error}")
            continue
        scores = dict(zip(DATA, (score(fit, s) for s in series), strict=True))
        found.append(Model(key, words, fit, sure, scores))
    progress(len(methods), len(methods))
    return Identified(series, tuple(found), tuple(left_out))


def _ls(train: Series) -> tuple[Fit, Uncertainty]:
    found = least_squares(PAPER, train)
    return as_fit(found, train), of_regression(found, "coloured")


def _ls_white(train: Series) -> tuple[Fit, Uncertainty]:
    found = least_squares(PAPER, train)
    return as_fit(found, train), of_regression(found, "white")


def _iv(train: Series) -> tuple[Fit, Uncertainty]:
    found = instrumental_variables(PAPER, train, fit_output_error(PAPER, [train]).values[:-2])
    return as_fit(found, train), of_regression(found, "coloured")


def _oe(train: Series) -> tuple[Fit, Uncertainty]:
    fit = fit_output_error(PAPER, [train])
    return fit, of_fit(fit, [train], "bootstrap")


def _linear(train: Series) -> tuple[Fit, None]:
    return fit_output_error(LINEAR, [train]), None


def _memory(train: Series) -> tuple[Fit, None]:
    return fit_output_error(MEMORY, [train]), None


_METHODS: tuple[tuple[str, str, Callable[[Series], tuple[Fit, Uncertainty | None]]], ...] = (
    ("linear", "linear model, Eq. 1", _linear),
    ("ls_white", "Eq. 2 by least squares, Eqs. 6 to 10, intervals for white residuals (as the paper)", _ls_white),
    ("ls", "Eq. 2 by least squares, intervals for coloured residuals", _ls),
    ("iv", "Eq. 2 by instrumental variables", _iv),
    ("oe", "Eq. 2 by output error, intervals by block bootstrap", _oe),
    ("memory", f"Eq. 2 with {words_of(MEMORY)}, output error", _memory),
)


def table1() -> dict[str, tuple[float, float, float]]:
    """The paper's Table 1: name -> mean and the ends of its interval."""
    bending = load_parameters(shipped()).bending
    entries = {name: getattr(bending, name) for name in PAPER.names}
    return {name: (e.value, e.min, e.max) for name, e in entries.items()}


class FitTally:
    """Rigs of the rig layer, one per seed, and how well what their Data1 gave simulates their Data2 and Data3; in this process.

    Attributes:
        steps: of work in each rig.
        block: rigs after which it is worth keeping what was found.
        found: of each rig its `seed`, and per model (`oe`: Eq. 2 alone, `memory`) the NRMSE fits, %.
    """

    steps, block = 1, 1

    def __init__(self, memory: Structure = MEMORY) -> None:
        self.memory = memory
        self.found: list[dict[str, Any]] = []

    @property
    def rigs(self) -> int:
        """How many."""
        return len(self.found)

    def add(self, seed: int, step: Callable[[int], None]) -> None:
        """Excite, fit and score one more rig."""
        step(0)
        plant = PlantConfig(layer="rig", seed=seed)
        data1, data2 = halves(excite(FAST, plant, seed))
        data3 = excite(SLOW, plant, seed)
        bare = fit_output_error(PAPER, [data1])
        fits = {"oe": bare, "memory": fit_output_error(self.memory, [data1], bare)}
        scores = {key: {"Data2": score(fit, data2), "Data3": score(fit, data3)} for key, fit in fits.items()}
        self.found.append({"seed": seed, **scores})

    def counted(self) -> dict[str, Any]:
        """Of one or more rigs: all fits, and per model and data their `median`, the `worst` and of which rig it is."""
        return {"rigs": self.rigs, "models": {key: self._over_rigs(key) for key in ("oe", "memory")}, "fits": self.found}

    def _over_rigs(self, key: str) -> dict[str, dict[str, float]]:
        out = {}
        for data in DATA[1:]:
            fits = [rig[key][data] for rig in self.found]
            worst = int(np.argmin(fits))
            out[data] = {"median": float(np.median(fits)), "worst": fits[worst], "worst_seed": self.found[worst]["seed"]}
        return out
