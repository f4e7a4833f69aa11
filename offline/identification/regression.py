"""Linear regression on filtered signals: the paper's least squares (Eqs. 6 to 10), and instrumental variables.

No signal is differentiated: a filter H_f of relative degree two or more stands before every term of Eq. 2, and s H_f and
s^2 H_f take its derivatives. Every filter is the bilinear image of its continuous one, the same for all terms.

Least squares is biased where the angle is noisy, because the noise stands in the regressors too. Instrumental variables take
the regressors of a simulated, noise-free angle as instruments and the model's own linearisation as filter, again and again
(the refined instrumental variables of Young, Garnier and others; here for the quasi-linear Eq. 2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import bilinear, lfilter

from softloop.offline.identification.output_error import Fit, Problem, first_states
from softloop.offline.identification.series import Series, nrmse_fit
from softloop.offline.identification.structure import Structure
from softloop.wire.errors import BadConfig

Floats = NDArray[np.float64]

CUTOFF_RAD_S = 20.0  # the paper does not say; well above the actuator's own 8 rad/s
TRANSIENTS = 12.0  # time constants of the filter that are left out at the start
ITERATIONS, CHANGE = 8, 1e-4


@dataclass(frozen=True)
class Filter:
    """H_f(s) = gain / denominator(s), `denominator` from the highest power down."""

    denominator: tuple[float, ...]
    gain: float

    def __call__(self, signal: Floats, derivative: int, sample_s: float) -> Floats:
        """`signal` (n,) through s^derivative H_f."""
        numerator = [self.gain] + [0.0] * derivative
        return lfilter(*bilinear(numerator, self.denominator, fs=1.0 / sample_s), signal)

    @property
    def settle_s(self) -> float:
        """How long its start is felt."""
        return TRANSIENTS / float(np.min(-np.roots(self.denominator).real))


def low_pass(cutoff_rad_s: float = CUTOFF_RAD_S) -> Filter:
    """(w / (s + w))^3: relative degree three, so that s^2 H_f lets no noise pass at once."""
    w = cutoff_rad_s
    return Filter((1.0, 3.0 * w, 3.0 * w**2, w**3), w**3)


@dataclass(frozen=True)
class Regression:
    """Y = Phi theta + error, and what solved it.

    Attributes:
        structure: the model, without options.
        theta: (p,), in the order of Eq. 9.
        phi: (n, p), Eq. 8.
        instruments: (n, p); `phi` itself for least squares.
        error: (n,), Y - Phi theta.
    """

    structure: Structure
    theta: Floats
    phi: Floats
    instruments: Floats
    error: Floats


def regressors(structure: Structure, series: Series, angle_deg: Floats, hf: Filter) -> tuple[Floats, Floats]:
    """Phi (n, p) and Y (n,) of Eqs. 7 and 8 from an even series and the angle that stands in them."""
    h, y = series.sample_s, angle_deg
    columns = [hf(-(y ** (i + 1)), 0, h) for i in range(structure.m + 1)]
    columns += [hf(y**j * p, 0, h) for p in series.pressure_kpa.T for j in range(structure.n + 1)]
    columns += [hf(-(y ** (k + 1)) / (k + 1), 1, h) for k in range(structure.r + 1)]
    columns.append(hf(np.ones_like(y), 0, h))
    settled = series.time_s - series.time_s[0] >= hf.settle_s
    return np.stack(columns, axis=1)[settled], hf(y, 2, h)[settled]


def least_squares(structure: Structure, series: Series, hf: Filter | None = None) -> Regression:
    """Eq. 10 by least squares on the counted part of a series. Raises BadConfig when the series is too short for the filter."""
    even = _even(structure, series, hf or low_pass())
    phi, target = regressors(structure, even, even.angle_deg, hf or low_pass())
    theta = _solve(phi, phi, target)
    return Regression(structure, theta, phi, phi, target - phi @ theta)


def instrumental_variables(structure: Structure, series: Series, start: Floats) -> Regression:
    """Refined instrumental variables from a start (p,) in the order of Eq. 9 whose free simulation is stable.

    Raises:
        BadConfig: the series is too short, or no iterate's simulation stays finite.
    """
    theta, found = start, None
    for _ in range(ITERATIONS):
        hf = _own_filter(structure, theta, series)
        even = _even(structure, series, hf)
        clean = _simulated_on(even, structure, theta, series)
        if not np.abs(clean).max() < 10.0 * np.abs(series.angle_deg).max():
            break
        phi, target = regressors(structure, even, even.angle_deg, hf)
        instruments, _ = regressors(structure, even, clean, hf)
        before, theta = theta, _solve(instruments, phi, target)
        found = Regression(structure, theta, phi, instruments, target - phi @ theta)
        if np.max(np.abs(theta - before) / np.maximum(np.abs(before), 1e-12)) < CHANGE:
            break
    if found is None:
        raise BadConfig(f"{series.name}: instrumental variables need a start whose simulation is stable")
    return found


def as_fit(regression: Regression, series: Series) -> Fit:
    """A regression's parameters as a model that can be simulated and scored; the first state is the measured one."""
    starts = first_states([series])
    values = np.concatenate([regression.theta, starts[0]])
    problem = Problem(regression.structure, [series])
    counted = series.counted
    fit = nrmse_fit(series.angle_deg[counted], problem.simulated(values, starts)[0][counted])
    return Fit(regression.structure, values, starts, (fit,))


def _even(structure: Structure, series: Series, hf: Filter) -> Series:
    even = series.uniform()
    left_s = even.time_s[-1] - even.time_s[0] - hf.settle_s
    if left_s < 4 * structure.size * even.sample_s:
        raise BadConfig(
            f"{series.name}: {left_s:.3g} s are left after the filter has settled: too few for {structure.size} values"
        )
    return even


def _own_filter(structure: Structure, theta: Floats, series: Series) -> Filter:
    """The model linearised at the mean angle, 1 / (s^2 + c s + k): the filter that suits white noise on the angle."""
    y, poly = float(series.angle_deg[series.counted].mean()), np.polynomial.polynomial.polyval
    a, c = theta[structure.terms("a")], theta[structure.terms("c")]
    stiffness = max(float(poly(y, a * np.arange(1, len(a) + 1))), 1.0)
    return Filter((1.0, max(float(poly(y, c)), 0.5 * stiffness**0.5), stiffness), stiffness)


def _simulated_on(even: Series, structure: Structure, theta: Floats, series: Series) -> Floats:
    starts = first_states([series])
    values = np.concatenate([theta, starts[0]])
    angle = Problem(structure, [series]).simulated(values, starts)[0]
    return np.interp(even.time_s, series.time_s, angle)


def _solve(instruments: Floats, phi: Floats, target: Floats) -> Floats:
    """Theta from Z^T Phi theta = Z^T Y, columns brought to like size first; least squares by QR when Z is Phi."""
    size = np.abs(phi).max(axis=0)
    if instruments is phi:
        return np.linalg.lstsq(phi / size, target, rcond=None)[0] / size
    z = instruments / size
    return np.linalg.solve(z.T @ (phi / size), z.T @ target) / size
