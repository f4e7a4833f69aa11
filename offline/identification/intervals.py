"""How sure the values are: standard errors that hold for white residuals, for coloured ones, and for errors of structure.

- `white`: the textbook's covariance, which is what the paper's printed intervals have the size of. Only right when residuals
  are white.
- `coloured`: the residuals are a stationary process that the input knows nothing of (noise of the sensors, also noise of the
  pressure's sensor that has gone through the actuator). Of a regression's residuals, whose colour is its filter's, an
  autoregressive model; of output error's, the smoothed spectrum: their white noise of the angle hides the slow noise that went
  through the actuator from an autoregressive model of few terms, and it is the slow part that moves the parameters.
- `bootstrap`: blocks of the experiment are drawn anew; takes what the model leaves out, as far as it forgets within a block.
- `between`: several experiments, each fitted on its own; takes everything that differs between them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter
from scipy.stats import t as student

from softloop.offline.identification.output_error import Fit, Problem
from softloop.offline.identification.regression import Regression
from softloop.offline.identification.series import Series

Floats = NDArray[np.float64]

LEVEL = 0.95
ORDER_MOST = 40  # of the autoregressive model
BLOCK_S = 10.0
DRAWS = 400
SMOOTH_BINS = 20  # of the spectrum, to either side: far more than the unknowns, which take their own share of the residuals away
MOVED = 1e-2  # a direction without information moves an unknown when it has this part of it


@dataclass(frozen=True)
class Uncertainty:
    """Covariance of a fit's parameters.

    Attributes:
        names, values: (p,).
        covariance: (p, p).
        degrees: of freedom of Student's t; infinite for a normal.
        method: one of the words above.
    """

    names: tuple[str, ...]
    values: Floats
    covariance: Floats
    degrees: float
    method: str

    @property
    def errors(self) -> Floats:
        """Standard errors, (p,)."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def interval(self, level: float = LEVEL) -> tuple[Floats, Floats]:
        """Low and high ends, (p,) each."""
        half = float(student.ppf(0.5 + 0.5 * level, self.degrees)) * self.errors
        return self.values - half, self.values + half


def sensitivities(fit: Fit, experiments: list[Series]) -> tuple[Floats, list[Floats], list[Floats]]:
    """The unknowns' scales (q,), and of each experiment residuals (n,) and derivatives of the angle by all unknowns (n, q).

    Unknowns are the free parameters, then the first states.
    """
    problem = Problem(fit.structure, experiments)
    unknowns = problem.pack(fit.values, fit.starts)
    residuals, jacobian = problem.residuals(unknowns, fit.values), problem.jacobian(unknowns, fit.values)
    ends = np.cumsum([int(e.counted.sum()) for e in experiments])
    scale = np.concatenate([problem.scale[:-2][problem.free], np.tile(problem.scale[-2:], len(experiments))])
    return scale, np.split(residuals, ends)[:-1], np.split(jacobian, ends)[:-1]


def of_fit(fit: Fit, experiments: list[Series], method: str, seed: int = 1) -> Uncertainty:
    """Uncertainty of an output error fit by `white`, `coloured` or `bootstrap`."""
    scale, residuals, jacobians = sensitivities(fit, experiments)
    names = [n for n in fit.structure.names if not (fit.structure.at_rest and n == "d")]
    kept = len(names)
    degrees = np.inf
    if method == "bootstrap":
        covariance, degrees = bootstrap(residuals, jacobians, [e.time_s[e.counted] for e in experiments], seed)
    else:
        gain = _damped_inverse(np.sum([j.T @ j for j in jacobians], axis=0))
        meat_of = _white_meat if method == "white" else _spectral_meat
        meat = np.sum([meat_of(r, j) for r, j in zip(residuals, jacobians, strict=True)], axis=0)
        covariance = gain @ meat @ gain
    covariance = (covariance * np.outer(scale, scale))[:kept, :kept]
    named = fit.named()
    return Uncertainty(tuple(names), np.array([named[n] for n in names]), covariance, degrees, method)


def of_regression(found: Regression, method: str) -> Uncertainty:
    """Uncertainty of least squares or instrumental variables by `white` or `coloured`."""
    size = np.abs(found.phi).max(axis=0)
    z, phi = found.instruments / size, found.phi / size
    gain = np.linalg.inv(z.T @ phi)
    covariance = gain @ _meat(found.error, z, method) @ gain.T / np.outer(size, size)
    return Uncertainty(found.structure.names, found.theta, covariance, np.inf, method)


def _meat(error: Floats, columns: Floats, method: str) -> Floats:
    """Covariance of columns^T error: the error white, or autoregressive."""
    if method == "white":
        return _white_meat(error, columns)
    coefficients, variance = autoregressive(error)
    # error = w / A(q) with white w, so columns^T error = (columns filtered by 1 / A backwards in time)^T w.
    shaped = lfilter([1.0], coefficients, columns[::-1], axis=0)
    return shaped.T @ shaped * variance


def _white_meat(error: Floats, columns: Floats) -> Floats:
    return columns.T @ columns * float(error @ error) / max(len(error) - columns.shape[1], 1)


def _spectral_meat(error: Floats, columns: Floats) -> Floats:
    """Covariance of columns^T error by Parseval: the columns' spectra weighed with the error's smoothed power."""
    n = len(error)
    power = np.abs(np.fft.rfft(error)) ** 2 / max(n - columns.shape[1], 1)
    wide = min(SMOOTH_BINS, len(power) - 1)
    window = np.bartlett(2 * wide + 3)[1:-1]
    mirrored = np.pad(power, wide, "reflect") if wide else power
    smooth = np.convolve(mirrored, window / window.sum(), "valid")
    spectra = np.fft.rfft(columns, axis=0)
    both_sides = np.full(len(power), 2.0)
    both_sides[0] = 1.0
    if n % 2 == 0:
        both_sides[-1] = 1.0
    return np.asarray(((spectra.conj().T * (both_sides * smooth)) @ spectra).real / n, np.float64)


def autoregressive_covariance(error: Floats, jacobian: Floats) -> Floats:
    """Covariance of least squares unknowns (q, q) from residuals (n,) that are autoregressive and derivatives (n, q)."""
    gain = _damped_inverse(jacobian.T @ jacobian)
    return gain @ _meat(error, jacobian, "coloured") @ gain


def autoregressive(error: Floats, most: int = ORDER_MOST) -> tuple[Floats, float]:
    """A(q) = 1 + a1 q^-1 + ... and the variance of its white input, by Yule and Walker, the order by Schwarz's criterion."""
    n = len(error)
    spectrum = np.abs(np.fft.rfft(error, 2 * n)) ** 2
    correlation = np.fft.irfft(spectrum)[: most + 1] / n
    best = (np.inf, np.ones(1), float(correlation[0]))
    for order in range(most + 1):
        a = solve_toeplitz(correlation[:order], -correlation[1 : order + 1]) if order else np.zeros(0)
        variance = max(float(correlation[0] + a @ correlation[1 : order + 1]), 1e-300)
        best = min(best, (n * np.log(variance) + order * np.log(n), np.concatenate([[1.0], a]), variance), key=lambda b: b[0])
    return best[1], best[2]


def bootstrap(
    residuals: list[Floats], jacobians: list[Floats], times_s: list[Floats], seed: int, block_s: float = BLOCK_S
) -> tuple[Floats, float]:
    """Covariance of the unknowns over DRAWS resamplings of blocks, one Gauss-Newton step each, and its degrees of freedom.

    The blocks of all experiments are drawn together. With few blocks the spread is itself uncertain; Student's t says so.
    """
    scores, squares = [], []
    for r, j, t in zip(residuals, jacobians, times_s, strict=True):
        count = max(int((t[-1] - t[0]) // block_s), 2)
        for rows in np.array_split(np.arange(len(r)), count):
            scores.append(j[rows].T @ r[rows])
            squares.append(j[rows].T @ j[rows])
    score, square, blocks = np.array(scores), np.array(squares), len(scores)
    random = np.random.RandomState(seed)  # its stream is frozen by numpy's policy
    weights = random.multinomial(blocks, np.full(blocks, 1.0 / blocks), DRAWS).astype(float)
    steps = [-_damped_inverse(np.tensordot(w, square, 1)) @ (w @ score) for w in weights]
    covariance = np.cov(np.array(steps), rowvar=False) * blocks / (blocks - 1.0)
    return covariance, float(blocks - 1)


def between(fits: list[Fit]) -> Uncertainty:
    """Mean and its covariance over fits of the same structure to different experiments, two or more."""
    names = fits[0].structure.names
    values = np.array([f.values[: len(names)] for f in fits])
    covariance = np.atleast_2d(np.cov(values, rowvar=False)) / len(fits)
    return Uncertainty(names, values.mean(axis=0), covariance, float(len(fits) - 1), "between")


def information_rank(jacobian: Floats, tolerance: float = 1e-8) -> tuple[int, Floats]:
    """Rank of J^T J with columns of unit length, and its singular values relative to the largest, (q,)."""
    length = np.linalg.norm(jacobian, axis=0)
    values = np.linalg.svd(jacobian / np.where(length > 0, length, 1.0), compute_uv=False)
    relative: Floats = np.asarray(values / max(float(values[0]), 1e-300), np.float64)
    return int(np.sum(relative > tolerance)), relative


def shown_alone(jacobian: Floats, tolerance: float = 1e-8) -> NDArray[np.bool_]:
    """Which unknowns the data show each by itself, (q,): those that no direction without information moves."""
    length = np.linalg.norm(jacobian, axis=0)
    _, values, rows = np.linalg.svd(jacobian / np.where(length > 0, length, 1.0), full_matrices=True)
    strength = np.zeros(jacobian.shape[1])
    strength[: len(values)] = values / max(float(values[0]), 1e-300)
    blind = rows[strength <= tolerance]
    return np.asarray((length > 0) & (np.abs(blind).max(axis=0, initial=0.0) < MOVED), np.bool_)


def _damped_inverse(square: Floats) -> Floats:
    """Inverse of J^T J; directions that the data do not show at all get none of the variance."""
    size = np.sqrt(np.maximum(np.diag(square), 1e-300))
    return np.linalg.pinv(square / np.outer(size, size), rcond=1e-13, hermitian=True) / np.outer(size, size)
