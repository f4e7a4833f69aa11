"""How sure the values are: standard errors that hold for white residuals, for coloured ones, and for errors of structure.

- `white`: the textbook's covariance, which is what the paper's printed intervals have the size of. Only right when residuals
  are white.
- `coloured`: the residuals are a stationary process that the input knows nothing of (noise of the sensors, also noise of the
  pressure's sensor that has gone through the actuator). Of a regression's residuals, whose colour is its filter's, an
  autoregressive model; of output error's, the smoothed spectrum: their white noise of the angle hides the slow noise that went
  through the actuator from an autoregressive model of few terms, and it is the slow part that moves the parameters.
- `bootstrap`: blocks of the experiment are drawn anew; takes what the model leaves out, as far as it forgets within a block.
  Where the excitation repeats itself, so do the errors of structure, and periods are no new blocks.
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
Indices = NDArray[np.int64]

LEVEL = 0.95
ORDER_MOST = 40  # of the autoregressive model
BLOCK_S, BLOCKS_LEAST = 10.0, 4
LEFT_LEAST = 0.01  # of a block's residuals, left by the fit: a direction that one block alone shows has none
DIFFERENT, ALIKE = 0.5, 0.99  # correlations of the pressure: with what it is not, with what it is a period later
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


def of_fit(fit: Fit, experiments: list[Series], method: str) -> Uncertainty:
    """Uncertainty of an output error fit by `white`, `coloured` or `bootstrap`."""
    scale, residuals, jacobians = sensitivities(fit, experiments)
    names = [n for n in fit.structure.names if not (fit.structure.at_rest and n == "d")]
    kept = len(names)
    degrees = np.inf
    if method == "bootstrap":
        covariance, degrees = bootstrap(residuals, jacobians, [blocks_of(e) for e in experiments])
    else:
        gain = _damped_inverse(np.sum([j.T @ j for j in jacobians], axis=0))
        pairs = zip(residuals, jacobians, strict=True)
        meat = np.sum([_white_meat(r, j) if method == "white" else _spectral_meat(r, j, gain) for r, j in pairs], axis=0)
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


def _spectral_meat(error: Floats, columns: Floats, gain: Floats) -> Floats:
    """Covariance of columns^T error by Parseval: the columns' spectra weighed with the error's smoothed power.

    The fit has taken away its share of the error, and most of it at the few frequencies at which the columns are strong; what
    is smoothed is therefore the power that is left over the part that could be left.

    Args:
        error: (n,), what the fit has left.
        columns: (n, q), derivatives.
        gain: (q, q), inverse of the sum of columns^T columns over all experiments.
    """
    n = len(error)
    spectra = np.fft.rfft(columns, axis=0)
    taken = np.einsum("ki,ij,kj->k", spectra.conj(), gain, spectra, optimize=True).real / n
    smooth = _smoothed(np.abs(np.fft.rfft(error)) ** 2 / n) / np.maximum(_smoothed(1.0 - taken), 1.0 / n)
    both_sides = np.full(len(smooth), 2.0)
    both_sides[0] = 1.0
    if n % 2 == 0:
        both_sides[-1] = 1.0
    return np.asarray(((spectra.conj().T * (both_sides * smooth)) @ spectra).real / n, np.float64)


def _smoothed(power: Floats) -> Floats:
    """Weighted mean over SMOOTH_BINS neighbours to either side, mirrored at the ends."""
    wide = min(SMOOTH_BINS, len(power) - 1)
    window = np.bartlett(2 * wide + 3)[1:-1]
    mirrored = np.pad(power, wide, "reflect") if wide else power
    return np.convolve(mirrored, window / window.sum(), "valid")


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


def bootstrap(residuals: list[Floats], jacobians: list[Floats], blocks: list[list[Indices]]) -> tuple[Floats, float]:
    """Covariance of the unknowns over blocks drawn anew, one Gauss-Newton step each, and its degrees of freedom.

    It is what draws with independent weights of mean and variance 1 come to when there are very many of them, so that none has
    to be made. Of each block's residuals the fit has taken away a share, the more the fewer blocks there are; they are made
    larger by as much (Bell and McCaffrey, 2002). With few blocks the spread is itself uncertain; Student's t says so. The blocks
    of all experiments, `blocks_of` each, count together.
    """
    pairs = [(j[rows], r[rows]) for r, j, own in zip(residuals, jacobians, blocks, strict=True) for rows in own]
    squares = [j.T @ j for j, _ in pairs]
    size = np.sqrt(np.maximum(np.diag(np.sum(squares, axis=0)), 1e-300))
    values, vectors = np.linalg.eigh(np.sum(squares, axis=0) / np.outer(size, size))
    root = vectors * np.where(values > 1e-13 * values[-1], 1.0 / np.sqrt(np.maximum(values, 1e-300)), 0.0) @ vectors.T / size
    steps = []
    for (j, r), square in zip(pairs, squares, strict=True):
        taken, turned = np.linalg.eigh(root @ square @ root.T)
        left = turned / np.sqrt(np.maximum(1.0 - taken, LEFT_LEAST)) @ turned.T
        steps.append(root.T @ left @ root @ (j.T @ r))
    found = np.array(steps)
    return found.T @ found, float(len(steps) - 1)


def blocks_of(experiment: Series, block_s: float = BLOCK_S) -> list[Indices]:
    """Rows of the counted samples, block by block.

    Where the pressure repeats itself, so does all that the model leaves out: what stands at the same place of each period is one
    block, for the second time shows nothing that the first did not. A period is cut into BLOCKS_LEAST blocks or more.
    """
    time_s = experiment.time_s[experiment.counted]
    period_s = period_of(time_s, experiment.pressure_kpa[experiment.counted])
    if period_s is None:
        return np.array_split(np.arange(len(time_s)), max(int((time_s[-1] - time_s[0]) // block_s), 2))
    count = max(int(period_s // block_s), BLOCKS_LEAST)
    place = (((time_s - time_s[0]) / period_s) % 1.0 * count).astype(np.int64)
    return [np.flatnonzero(place == k) for k in range(count)]


def period_of(time_s: Floats, pressure_kpa: Floats) -> float | None:
    """After how long the pressures (n, inputs) at times (n,) repeat themselves, by their correlation; None when they do not.

    They must do so at least once, a whole period long.
    """
    n, step_s = len(time_s), float(time_s[-1] - time_s[0]) / (len(time_s) - 1)
    even = time_s[0] + step_s * np.arange(n)
    lags, both, power = n // 2, np.zeros(n), np.zeros(n)
    for column in pressure_kpa.T:
        p = np.interp(even, time_s, column - column.mean())
        both += np.fft.irfft(np.abs(np.fft.rfft(p, 2 * n)) ** 2)[:n]
        power += p**2
    before, after = np.cumsum(power)[::-1], np.cumsum(power[::-1])[::-1]  # of what is compared at each lag
    likeness = (both / np.sqrt(np.maximum(before * after, 1e-300)))[: lags + 1]
    different = np.flatnonzero(likeness < DIFFERENT)
    alike = np.flatnonzero(likeness > ALIKE)
    alike = alike[alike > different[0]] if len(different) else alike[:0]
    if not len(alike):
        return None
    gaps = np.flatnonzero(np.diff(alike) > 1)
    peak = alike[: gaps[0] + 1] if len(gaps) else alike
    return float(peak[np.argmax(likeness[peak])] * step_s)


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
