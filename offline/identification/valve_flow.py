"""The valve model of Eqs. 12 and 16 from flow tests, as in Fig. 4: flow over current at several pressures.

k_v2 / k_v4 and k_v3 / k_v5 are both (r0 / r1)^2 by their definitions below Eq. 16, so that the six coefficients have five free
numbers. The fit has those five: k_v1, k_v2, k_v3, k_v6 and the ratio (r1 / r0)^2. A flow meter sees C_f A: with C_f given the
areas follow. What the tests do not show (one pressure alone says nothing of k_v2 to k_v5) is said from the rank.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import types
from numpy.typing import NDArray
from scipy.optimize import least_squares

from softloop.dynamics.gas import ATMOSPHERE_PA, PA_PER_KPA, mass_flux
from softloop.dynamics.parameters import VALVE_SHAPE, VALVE_SHAPE_TYPE
from softloop.dynamics.valve import orifice_area
from softloop.offline.identification.intervals import Uncertainty, information_rank, shown_alone
from softloop.offline.identification.series import nrmse_fit
from softloop.wire.errors import BadFile
from softloop.wire.kernel import array_of, kernel, new_record

Floats = NDArray[np.float64]
_F8 = types.f8
_VECTOR = array_of(_F8)

NAMES = ("k_v1_m2_ma", "k_v2_pa", "k_v3_m2_pa", "k_v6_m2", "ratio")
SCALE = np.array([5e-9, 5e-7, 5e-13, 3e-7, 0.5])
LOW, HIGH = np.array([1e-3, 0.0, 0.0, 0.0, 0.0]), np.array([1e3, 20.0, 1e3, 1e3, 2.0])
STARTS = (np.array([1.0, 0.1, 0.1, 1.0, 1.0]), np.array([0.3, 1.0, 1.0, 0.3, 1.5]), np.array([3.0, 0.1, 3.0, 3.0, 0.5]))
STEP, LEAST_TESTS, RANK_TOLERANCE = 1e-4, 10, 1e-4


@dataclass(frozen=True)
class FlowTests:
    """Steady flows, (n,) each: gauge pressures in kPa, current in mA, flow in kg/s."""

    current_ma: Floats
    upstream_kpa: Floats
    downstream_kpa: Floats
    flow_kg_s: Floats


@dataclass(frozen=True)
class ValveFit:
    """A valve's five numbers.

    Attributes:
        uncertainty: of those of NAMES that the tests show, all where the rank is full; None where they show none of them.
        values: (5,), of NAMES; what the tests do not show is one value of many that fit.
        rank: of the information matrix, at most 5.
        fit: NRMSE fit of the flow, %.
    """

    uncertainty: Uncertainty | None
    values: Floats
    rank: int
    fit: float

    @property
    def shown(self) -> tuple[str, ...]:
        """The names that the tests show."""
        return self.uncertainty.names if self.uncertainty else ()

    def coefficients(self) -> dict[str, float]:
        """All six coefficients of Eq. 16."""
        k1, k2, k3, k6, ratio = self.values.tolist()
        return {"k_v1": k1, "k_v2": k2, "k_v3": k3, "k_v4": k2 * ratio, "k_v5": k3 * ratio, "k_v6": k6}


@kernel(types.void(VALVE_SHAPE_TYPE, _F8, _F8, _F8, _F8, _VECTOR, _VECTOR, _VECTOR, _VECTOR))
def flows(
    shape: NDArray[np.void], k_v1: float, k_v6: float, discharge: float, temperature_k: float,
    current_ma: Floats, upstream_kpa: Floats, downstream_kpa: Floats, out: Floats,
) -> None:  # fmt: skip
    """Fill `out` (n,) with the mass flows of Eqs. 12 and 16, kg/s."""
    for i in range(out.size):
        up, down = PA_PER_KPA * upstream_kpa[i], PA_PER_KPA * downstream_kpa[i]
        area = orifice_area(shape, k_v1, k_v6, current_ma[i], up, down)
        out[i] = area * mass_flux(up + ATMOSPHERE_PA, down + ATMOSPHERE_PA, temperature_k, discharge)


def modelled(values: Floats, tests: FlowTests, discharge: float, temperature_k: float, area_max_m2: float = 1.0) -> Floats:
    """Flows (n,) of the five numbers; without `area_max_m2` the spool has no upper stop."""
    shape, out = new_record(VALVE_SHAPE), np.empty(len(tests.flow_kg_s))
    shape.k_v2_pa, shape.k_v3_m2_pa = values[1], values[2]
    shape.k_v4_pa, shape.k_v5_m2_pa = values[1] * values[4], values[2] * values[4]
    shape.area_max_m2 = area_max_m2
    current, up, down = (np.ascontiguousarray(c) for c in (tests.current_ma, tests.upstream_kpa, tests.downstream_kpa))
    flows(shape, float(values[0]), float(values[3]), discharge, temperature_k, current, up, down, out)
    return out


def fit_valve(tests: FlowTests, discharge: float = 1.0, temperature_k: float = 293.15) -> ValveFit:
    """Least squares of the flow. With `discharge` 1, k_v1, k_v3 and k_v6 hold C_f. Raises BadFile on too few tests."""
    count = int(np.sum(tests.flow_kg_s > 0.0))
    if count < LEAST_TESTS:
        raise BadFile(f"{count} flow tests with flow; the valve model needs {LEAST_TESTS} or more")
    size = float(tests.flow_kg_s.max())

    def residuals(unknowns: Floats) -> Floats:
        return (modelled(unknowns * SCALE, tests, discharge, temperature_k) - tests.flow_kg_s) / size

    tried = [least_squares(residuals, s, bounds=(LOW, HIGH), x_scale="jac", diff_step=STEP, max_nfev=400) for s in STARTS]
    best = min(tried, key=lambda t: float(t.cost))
    rank, _ = information_rank(best.jac, RANK_TOLERANCE)
    values = best.x * SCALE
    fit = nrmse_fit(tests.flow_kg_s, modelled(values, tests, discharge, temperature_k))
    shown = shown_alone(best.jac, RANK_TOLERANCE)
    if not shown.any():
        return ValveFit(None, values, rank, fit)
    degrees = max(len(best.fun) - rank, 1)
    length = np.linalg.norm(best.jac, axis=0)
    length[length == 0.0] = 1.0
    square = (best.jac / length).T @ (best.jac / length)
    inverse = np.linalg.pinv(square, rcond=RANK_TOLERANCE**2, hermitian=True) / np.outer(length, length)
    covariance = inverse * float(best.fun @ best.fun) / degrees * np.outer(SCALE, SCALE)
    names = tuple(n for n, s in zip(NAMES, shown, strict=True) if s)
    return ValveFit(
        Uncertainty(names, values[shown], covariance[np.ix_(shown, shown)], float(degrees), "white"), values, rank, fit
    )
