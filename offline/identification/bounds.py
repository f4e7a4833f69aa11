"""Bounds of the parameters for the laws: the box that covers what the covariance allows, as far as a law can feel it.

A law is robust against phi_b^T (theta - theta_hat), and sizes its robust terms by a box: theta_M^T |phi_b| (Eqs. 38, 47). Where
parameters can hardly be told apart (c2 and c3), each alone is uncertain by as much as itself, while the sum that enters Eq. 2
is well known. The box of three standard errors of each forgets that, and its theta_M^T |phi_b| is then many times what the
data leave open. Here the box is the smallest whose half widths w still hold, for every state of the excitation,

    w^T |phi_b|  >=  3 sqrt(phi_b^T Cov phi_b),

three standard errors of the acceleration itself. A linear programme finds it. No half width is over the paper's three standard
errors, or under three conditional ones (all others known), so that adaptation may move every parameter.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from softloop.offline.identification.output_error import BEYOND
from softloop.offline.identification.series import Series
from softloop.offline.identification.structure import PAPER
from softloop.wire.errors import BadConfig

Floats = NDArray[np.float64]

BOUND_ERRORS = 3.0  # "three standard deviations of the means", as the paper has it
ANGLES, RATES, PRESSURES = 12, 7, 4  # of the grid of states
_REST = 1e-9  # relative; the box of the paper meets the condition only just where one parameter stands alone


def regressors(angle_deg: Floats, rate_deg_s: Floats, pressure_kpa: Floats) -> Floats:
    """phi_b of Eqs. 24 and 36 in the order of Eq. 9, a row for each state, (n, 9)."""
    y, v = angle_deg, rate_deg_s
    columns = [-y, -(y**2), -(y**3), pressure_kpa, -v, -y * v, -(y**2) * v, -(y**3) * v, np.ones_like(y)]
    return np.stack(columns, axis=1)


def states_of(series: Series) -> Floats:
    """A grid over the box of angles, rates and pressures that an excitation went through, and some way beyond; phi_b, (n, 9)."""
    counted = series.counted
    angle, pressure = series.angle_deg[counted], series.pressure_kpa[counted, 0]
    fastest = (1.0 + BEYOND) * float(np.quantile(np.abs(_smooth_rate(series)), 0.999))
    axes = (
        _widened(angle, ANGLES),
        np.linspace(-fastest, fastest, RATES),
        _widened(pressure, PRESSURES),
    )
    return regressors(*(axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")))


def half_widths(covariance: Floats, phi: Floats) -> Floats:
    """The smallest half widths (p,) that hold three standard errors of every row of `phi` (n, p). Raises BadConfig."""
    marginal = BOUND_ERRORS * np.sqrt(np.maximum(np.diag(covariance), 0.0))
    if not (marginal > 0.0).all():
        raise BadConfig("the covariance has a variance that is not above 0; no bounds follow from it")
    information = np.linalg.pinv(covariance / np.outer(marginal, marginal), hermitian=True)
    alone = np.minimum(BOUND_ERRORS / np.sqrt(np.diag(information)), 1.0)
    size = np.abs(phi) * marginal  # unknowns are the half widths in parts of the marginal ones
    least = BOUND_ERRORS * np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", phi, covariance, phi), 0.0))
    shape = size / least[:, None]
    limits = np.stack([alone, np.ones(len(alone))], axis=1)
    found = linprog(shape.sum(axis=0), -shape, np.full(len(phi), _REST - 1.0), bounds=limits)
    if found.status != 0:
        raise BadConfig(f"no bounds follow from the covariance: {found.message}")
    return np.asarray(found.x * marginal, np.float64)


def bounds_of(covariance: Floats, series: Series) -> Floats:
    """Half widths (9,) for the laws from the covariance (9, 9) of the paper's parameters and what they were identified on."""
    if covariance.shape != (len(PAPER.names),) * 2:
        raise BadConfig(f"bounds for the laws need the paper's {len(PAPER.names)} parameters")
    return half_widths(covariance, states_of(series))


def _widened(values: Floats, count: int) -> Floats:
    low, high = float(values.min()), float(values.max())
    margin = BEYOND * (high - low)
    return np.linspace(low - margin, high + margin, count)


def _smooth_rate(series: Series) -> Floats:
    """Rate of the angle, deg/s, over a tenth of a second, so that the sensor's noise is no rate."""
    even = series.uniform()
    lag = max(round(0.1 / even.sample_s), 1)
    return (even.angle_deg[lag:] - even.angle_deg[:-lag]) / (lag * even.sample_s)
