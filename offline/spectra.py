"""How one signal follows another: residual, coherence, delay and gain, from spectra over the frequencies that are excited."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from softloop.offline.parity_bounds import EstimateConfig

Floats = NDArray[np.float64]
SEGMENTS_LEAST = 2.5  # their lengths: four half-overlapped ones, under which a coherence says nothing
_WEIGHT_LIMIT = 1.0 - 1e-9  # of a coherence in the weight g / (1 - g)
_ROUNDS = 5  # each leaves a tenth or less of the delay that was left
_RELATIVE_LEAST = 1e-9  # a swing smaller than this part of the value is rounding


@dataclass(frozen=True)
class Spectra:
    """Densities of x and y, one-sided, at `hz` (m,), and which frequencies x excites."""

    hz: Floats
    xx: Floats
    yy: Floats
    xy: NDArray[np.complex128]
    excited: NDArray[np.bool_]
    segments: int

    @property
    def coherence(self) -> Floats:
        """Magnitude squared, (m,); 0 where a density is 0."""
        both = self.xx * self.yy
        return np.divide(np.abs(self.xy) ** 2, both, out=np.zeros_like(both), where=both > 0.0)

    @property
    def gain(self) -> Floats:
        """|H1|, (m,); nan where x has no power."""
        return np.divide(np.abs(self.xy), self.xx, out=np.full_like(self.xx, np.nan), where=self.xx > 0.0)


@dataclass(frozen=True)
class Estimate:
    """What y is to x, both in their unit.

    Attributes:
        residual_rms, residual_max: of y less x.
        offset: its mean.
        coherence: over the excited band, weighted by x's power; None where x or y stands still.
        delay_ms: y behind x; None where the coherence is no more than chance gives.
        gain: y over x in the excited band; None likewise.
        low_hz, high_hz: ends of the excited band; None where x stands still.
    """

    residual_rms: float
    residual_max: float
    offset: float
    coherence: float | None = None
    delay_ms: float | None = None
    gain: float | None = None
    low_hz: float | None = None
    high_hz: float | None = None


def spectra(x: Floats, y: Floats, rate_hz: float, config: EstimateConfig) -> Spectra | None:
    """Welch's spectra of two signals (n,) sampled together; None where one stands still.

    Raises ValueError when they are shorter than one segment.
    """
    length = round(config.segment_s * rate_hz)
    if len(x) < length:
        raise ValueError(f"{len(x)} samples are fewer than a segment of {length}")
    if any(np.ptp(one) <= _RELATIVE_LEAST * (1.0 + np.abs(one).max()) for one in (x, y)):
        return None
    options = {"fs": rate_hz, "nperseg": length, "detrend": "constant"}
    hz, xx = signal.welch(x, **options)
    yy, xy = signal.welch(y, **options)[1], signal.csd(x, y, **options)[1]
    excited = xx >= 10.0 ** (config.excited_db / 10.0) * xx[1:].max()
    excited[0] = False  # the mean is no excitation; the offset says it
    return Spectra(hz, xx, yy, xy, excited, 1 + (len(x) - length) // (length - length // 2))


def estimate(x: Floats, y: Floats, rate_hz: float, config: EstimateConfig) -> Estimate:
    """Residual, coherence, delay and gain of y against x, (n,) each and finite. Raises ValueError as `spectra` does."""
    residual = y - x
    plain = (float(np.sqrt(np.mean(residual**2))), float(np.abs(residual).max()), float(residual.mean()))
    found = spectra(x, y, rate_hz, config)
    if found is None:
        return Estimate(*plain)
    band, power = found.excited, found.xx[found.excited]
    coherence = float(np.sum(power * found.coherence[band]) / power.sum())
    edges = (float(found.hz[band].min()), float(found.hz[band].max()))
    if coherence <= chance(found.segments):
        return Estimate(*plain, coherence, None, None, *edges)
    gain = float(np.abs(found.xy[band]).sum() / power.sum())
    return Estimate(*plain, coherence, 1e3 * delay_s(x, y, rate_hz, config), gain, *edges)


def chance(segments: int) -> float:
    """The coherence that unrelated signals stay under in 95 % of cases, with so many segments."""
    return float(1.0 - 0.05 ** (1.0 / max(segments - 1, 1)))


def delay_s(x: Floats, y: Floats, rate_hz: float, config: EstimateConfig) -> float:
    """By how much y is behind x: whole samples by their correlation, the rest by the slope of the cross-spectrum's phase.

    A window that is not moved along with the delay bends that phase towards 0, so y is moved by what was found and the rest
    estimated again, until there is none.
    """
    most = round(config.delay_max_s * rate_hz)
    behind = float(_whole_samples(x, y, most))
    inner = np.arange(most + 1, len(x) - most - 1)
    for _ in range(_ROUNDS):
        moved = np.interp(inner + np.clip(behind, -most, most), np.arange(len(y)), y)
        found = spectra(x[inner], moved, rate_hz, config)
        if found is None:
            break
        behind += rate_hz * _phase_slope_s(found)
    return behind / rate_hz


def _phase_slope_s(found: Spectra) -> float:
    """The delay in the cross-spectrum's phase. Each frequency weighs what its phase is worth: g / (1 - g) of its coherence g."""
    omega, phase = 2.0 * np.pi * found.hz[found.excited], np.angle(found.xy[found.excited])
    coherent = np.minimum(found.coherence[found.excited], _WEIGHT_LIMIT)
    weight = coherent / (1.0 - coherent)
    return -float(np.sum(weight * omega * phase) / np.sum(weight * omega**2))


def _whole_samples(x: Floats, y: Floats, most: int) -> int:
    """The lag of y behind x at which they are most alike, at most `most` samples."""
    together = signal.correlate(signal.detrend(y, type="constant"), signal.detrend(x, type="constant"), mode="full", method="fft")
    lags = signal.correlation_lags(len(y), len(x), mode="full")
    near = np.abs(lags) <= most
    return int(lags[near][together[near].argmax()])
