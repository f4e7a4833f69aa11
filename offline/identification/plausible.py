"""What a series and a fit have about them that asks for a second look: most often a column in another unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from softloop.offline.identification.series import Series

LEAST_FIT_PERCENT, MOST_SAMPLE_S, LEAST_ANGLE_DEG = 50.0, 0.5, 1.0
PRESSURES_KPA = (1.0, 1500.0)  # a range below the first is perhaps in bar, one above the second in Pa


def doubts(series: Series) -> list[str]:
    """Figures that are not like a bending actuator's in s, kPa and deg."""
    counted = series.counted
    pressure = float(np.ptp(series.pressure_kpa[counted], axis=0).max())
    angle = float(np.ptp(series.angle_deg[counted]))
    checks = (
        (series.sample_s > MOST_SAMPLE_S, f"a sample every {series.sample_s:.4g} s"),
        (not PRESSURES_KPA[0] <= pressure <= PRESSURES_KPA[1], f"a range of pressure of {pressure:.4g} kPa"),
        (angle < LEAST_ANGLE_DEG, f"a range of the angle of {angle:.4g} deg"),
    )
    return [text for doubtful, text in checks if doubtful]


def unit_hints(runs: Sequence[Series]) -> list[str]:
    """A line for each series that has such figures."""
    ask = "are the units s, kPa and deg? In --map a factor, such as t*0.001, brings them there"
    return [f"{run.name}: {' and '.join(found)}: {ask}" for run in runs if (found := doubts(run))]


def fit_hints(fits: Mapping[str, float]) -> list[str]:
    """A line for each training run, by name, that its own model does not fit, %."""
    poor = {name: fit for name, fit in fits.items() if not fit >= LEAST_FIT_PERCENT}
    ask = "are the columns the right ones, in s, kPa and deg, and does the pressure drive the angle?"
    return [f"{name}: a fit of {fit:.2f} % where it was trained: {ask}" for name, fit in poor.items()]
