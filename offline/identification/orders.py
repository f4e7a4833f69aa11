"""How many terms: the trade between fit and complexity that the paper mentions, as a table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from softloop.offline.identification.fitting import fit_output_error
from softloop.offline.identification.intervals import autoregressive, of_fit
from softloop.offline.identification.output_error import Fit, free_run, score
from softloop.offline.identification.series import Series
from softloop.offline.identification.structure import Structure

ORDERS = ((0, 0, 0), (1, 0, 0), (1, 0, 1), (2, 0, 0), (2, 0, 1), (2, 0, 2), (2, 0, 3), (2, 1, 3), (3, 0, 3), (3, 1, 3))


@dataclass(frozen=True)
class Choice:
    """One structure of the table.

    Attributes:
        structure: its orders.
        fit: NRMSE fit on the training data, %.
        validation: on each other series, %.
        schwarz: Schwarz's criterion per sample of the innovation, lower is better; residuals are first whitened, since
            neighbouring samples of a coloured residual do not count as two.
        uncertain: parameters whose 95 % interval holds 0.
    """

    structure: Structure
    fit: float
    validation: tuple[float, ...]
    schwarz: float
    uncertain: tuple[str, ...]


def compare(base: Structure, train: Series, validate: list[Series], progress: Callable[[int, int], None]) -> list[Choice]:
    """Fit each of ORDERS, with the options of `base`, to `train`."""
    out = []
    for done, (m, n, r) in enumerate(ORDERS):
        progress(done, len(ORDERS))
        fit = fit_output_error(replace(base, m=m, n=n, r=r), [train])
        out.append(_choice(fit, train, validate))
    progress(len(ORDERS), len(ORDERS))
    return out


def _choice(fit: Fit, train: Series, validate: list[Series]) -> Choice:
    counted = train.counted
    error = (free_run(fit, train) - train.angle_deg)[counted]
    _, variance = autoregressive(error - error.mean())
    schwarz = float(np.log(variance) + fit.structure.size * np.log(len(error)) / len(error))
    sure = of_fit(fit, [train], "coloured")
    low, high = sure.interval()
    uncertain = tuple(n for n, a, b in zip(sure.names, low, high, strict=True) if a <= 0.0 <= b)
    return Choice(fit.structure, fit.fits[0], tuple(score(fit, v) for v in validate), schwarz, uncertain)
