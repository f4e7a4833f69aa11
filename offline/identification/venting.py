"""A closed volume that empties through a leak or a vent: the flow law of Eqs. 19 and 21, and what it leaves out.

Three terms act on the pressure: an orifice (Eq. 21), a laminar part, and the gas itself, which cools as it expands and is warmed
by the wall within a time `wall_s`. Eq. 11 is the limit of a fast wall. From pressure alone only ratios to the volume can be
found: area, laminar conductance and volume move together. Their information matrix has rank 3 where there are 4 of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray
from scipy.optimize import least_squares

from softloop.dynamics.gas import ATMOSPHERE_PA, GAS_CONSTANT, KAPPA, PA_PER_KPA, mass_flux
from softloop.offline.identification.intervals import Uncertainty, autoregressive_covariance, information_rank
from softloop.offline.identification.series import nrmse_fit
from softloop.wire.errors import BadFile
from softloop.wire.kernel import array_of, kernel

Floats = NDArray[np.float64]
_F8 = types.f8
NAMES = ("orifice_per_volume_1_m", "laminar_1_s", "wall_s")
WALL_K = 293.15
SCALE = np.array([1e-4, 0.05, 2.0])
STARTS = (np.array([1.0, 0.5, 1.0]), np.array([0.3, 1.0, 0.1]), np.array([2.0, 0.1, 5.0]))
FIRST_SAMPLES, STEP, LEAST_SAMPLES = 5, 1e-6, 100
_TOP = 0.98  # without an input, venting begins when the pressure last was above this share of its peak


@dataclass(frozen=True)
class Vent:
    """Gauge pressure of one venting, (n,) each, from the instant at which nothing flows in any more."""

    name: str
    time_s: Floats
    pressure_kpa: Floats


@dataclass(frozen=True)
class VentFit:
    """The flow law of one or more ventings.

    Attributes:
        uncertainty: C_f A / V in 1/m, laminar conductance over V in 1/s, the wall's time in s.
        fits: NRMSE fit of each training run, %.
        rank: of the information matrix of area, conductance, wall and volume (4 would mean that all are identifiable).
    """

    uncertainty: Uncertainty
    fits: tuple[float, ...]
    rank: int


@kernel(types.UniTuple(_F8, 2)(array_of(_F8), _F8, _F8))
def rates(p: Floats, pressure_kpa: float, warmth: float) -> tuple[float, float]:
    """Rates of the gauge pressure, kPa/s, and of the gas temperature over the wall's, 1/s."""
    absolute = pressure_kpa + ATMOSPHERE_PA / PA_PER_KPA
    flux = mass_flux(PA_PER_KPA * pressure_kpa + ATMOSPHERE_PA, ATMOSPHERE_PA, WALL_K * warmth, 1.0)
    leaving = (p[0] * GAS_CONSTANT * WALL_K * flux / PA_PER_KPA + p[1] * pressure_kpa) * warmth / absolute
    warming = -(KAPPA - 1.0) * warmth * leaving + (1.0 - warmth) / p[2]
    return absolute * (warming / warmth - leaving), warming


@kernel(types.void(array_of(_F8), array_of(_F8), _F8, array_of(_F8)))
def empty(p: Floats, time_s: Floats, first_kpa: float, out: Floats) -> None:
    """Fill `out` (n,) with the pressure from its first value on; RK4, steps no longer than a fifth of the wall's time."""
    y, w = first_kpa, 1.0
    out[0] = y
    for n in range(time_s.size - 1):
        whole = time_s[n + 1] - time_s[n]
        steps = min(max(int(5.0 * whole / p[2]) + 1, 1), 200)
        h = whole / steps
        for _ in range(steps):
            a1, b1 = rates(p, y, w)
            a2, b2 = rates(p, y + 0.5 * h * a1, w + 0.5 * h * b1)
            a3, b3 = rates(p, y + 0.5 * h * a2, w + 0.5 * h * b2)
            a4, b4 = rates(p, y + h * a3, w + h * b3)
            y += h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
            w += h / 6.0 * (b1 + 2.0 * b2 + 2.0 * b3 + b4)
        out[n + 1] = y


def vent_of(name: str, time_s: Floats, pressure_kpa: Floats, inflow: Floats | None = None) -> Vent:
    """The last part of a record, from where `inflow` (n,) has become 0 for good, or from the pressure's peak. Raises BadFile."""
    if len(time_s) < LEAST_SAMPLES:
        raise BadFile(f"{name}: {len(time_s)} samples; {LEAST_SAMPLES} or more of venting are needed")
    flowing = pressure_kpa >= _TOP * pressure_kpa.max() if inflow is None else inflow != 0.0
    driven = np.flatnonzero(flowing)
    begin = int(driven[-1]) + 1 if len(driven) else 0
    if len(time_s) - begin < LEAST_SAMPLES:
        raise BadFile(f"{name}: {len(time_s) - begin} samples of venting; {LEAST_SAMPLES} or more are needed")
    return Vent(name, np.ascontiguousarray(time_s[begin:]), np.ascontiguousarray(pressure_kpa[begin:]))


def simulated(values: Floats, run: Vent, first_kpa: float) -> Floats:
    """The pressure from its first value alone, (n,)."""
    out = np.empty(len(run.time_s))
    empty(np.ascontiguousarray(values), run.time_s, first_kpa, out)
    return out


def first_pressure(run: Vent) -> float:
    """The pressure at the start: a line through the first samples, at the first of them."""
    time_s = run.time_s[:FIRST_SAMPLES] - run.time_s[0]
    return float(np.polyfit(time_s, run.pressure_kpa[:FIRST_SAMPLES], 1)[1])


def score_vent(values: Floats, run: Vent) -> float:
    """NRMSE fit of a free run, %."""
    return nrmse_fit(run.pressure_kpa, simulated(values, run, first_pressure(run)))


def fit_vent(runs: Sequence[Vent]) -> VentFit:
    """Output error over all runs; their first pressures are estimated too."""
    firsts = np.array([first_pressure(r) for r in runs])
    scale = np.concatenate([SCALE, np.maximum(firsts, 1.0)])

    def residuals(unknowns: Floats) -> Floats:
        values = unknowns * scale
        parts = [simulated(values[:3], r, f) - r.pressure_kpa for r, f in zip(runs, values[3:], strict=True)]
        return np.concatenate(parts)

    low = np.concatenate([[0.0, 0.0, 1e-2], np.full(len(runs), -np.inf)])
    begins = [np.concatenate([s, firsts / scale[3:]]) for s in STARTS]
    tried = [least_squares(residuals, b, bounds=(low, np.inf), x_scale="jac") for b in begins]
    best = min(tried, key=lambda t: float(t.cost))
    jacobian = _jacobian(residuals, best.x)
    covariance = autoregressive_covariance(best.fun, jacobian) * np.outer(scale, scale)
    values = best.x * scale
    uncertainty = Uncertainty(NAMES, values[:3], covariance[:3, :3], np.inf, "coloured")
    own = [nrmse_fit(r.pressure_kpa, simulated(values[:3], r, f)) for r, f in zip(runs, values[3:], strict=True)]
    return VentFit(uncertainty, tuple(own), _rank_with_volume(jacobian, best.x))


def _jacobian(residuals: Any, at: Floats) -> Floats:
    columns = []
    for i in range(len(at)):
        step = np.zeros(len(at))
        step[i] = STEP * max(1.0, abs(float(at[i])))
        columns.append((residuals(at + step) - residuals(at - step)) / (2.0 * step[i]))
    return np.stack(columns, axis=1)


def _rank_with_volume(jacobian: Floats, at: Floats) -> int:
    """Rank for area, conductance, wall and volume: more volume does what less area and conductance do."""
    volume = -(jacobian[:, 0] * at[0] + jacobian[:, 1] * at[1])
    rank, _ = information_rank(np.column_stack([jacobian[:, :3], volume]))
    return rank
