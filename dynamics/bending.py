"""The empirical bending model, Eqs. 2 to 5 in the regressor form of Eq. 24.

theta_a = [a0, -a1, a2, c0, -c1, c2, c3, d] and phi_a = [-y, y^2, -y^3, -v, y v, -y^2 v, -y^3 v, 1], y in deg, v in deg/s;
then theta_9 = b0. All nominal values are positive. Index i of the paper is i - 1 here.
"""

from __future__ import annotations

import numpy as np
from numba import types

from softloop.dynamics.parameters import THETA_TYPE
from softloop.wire.kernel import kernel

_F8 = types.f8


@kernel(_F8(THETA_TYPE, _F8, _F8))
def bending_drift(theta: np.ndarray, angle_deg: float, rate_deg_s: float) -> float:
    """phi_a^T theta_a of Eq. 24, deg/s2: all of the angular acceleration but the pressure's part."""
    y, v = angle_deg, rate_deg_s
    stiffness = y * (-theta[0] + y * (theta[1] - y * theta[2]))
    damping = v * (-theta[3] + y * (theta[4] - y * (theta[5] + y * theta[6])))
    return stiffness + damping + theta[7]


@kernel(_F8(THETA_TYPE, _F8, _F8, _F8))
def bending_acceleration(theta: np.ndarray, angle_deg: float, rate_deg_s: float, pressure_kpa: float) -> float:
    """Eq. 24, second line, without Delta_1; deg/s2."""
    return bending_drift(theta, angle_deg, rate_deg_s) + theta[8] * pressure_kpa


@kernel(types.void(_F8, _F8, THETA_TYPE))
def fill_phi_a(angle_deg: float, rate_deg_s: float, phi_a: np.ndarray) -> None:
    """Write phi_a of Eq. 24 into the first eight places of `phi_a`."""
    y, v = angle_deg, rate_deg_s
    phi_a[0] = -y
    phi_a[1] = y * y
    phi_a[2] = -y * y * y
    phi_a[3] = -v
    phi_a[4] = y * v
    phi_a[5] = -y * y * v
    phi_a[6] = -y * y * y * v
    phi_a[7] = 1.0


@kernel(_F8(THETA_TYPE, _F8, _F8))
def drift_slope_angle(theta: np.ndarray, angle_deg: float, rate_deg_s: float) -> float:
    """Partial derivative of `bending_drift` by the angle, 1/s2."""
    y, v = angle_deg, rate_deg_s
    stiffness = -theta[0] + y * (2.0 * theta[1] - 3.0 * y * theta[2])
    return stiffness + v * (theta[4] - y * (2.0 * theta[5] + 3.0 * y * theta[6]))


@kernel(_F8(THETA_TYPE, _F8))
def drift_slope_rate(theta: np.ndarray, angle_deg: float) -> float:
    """Partial derivative of `bending_drift` by the rate, -c(y), 1/s."""
    y = angle_deg
    return -theta[3] + y * (theta[4] - y * (theta[5] + y * theta[6]))


@kernel(_F8(THETA_TYPE, _F8, _F8, _F8))
def pressure_for(theta: np.ndarray, angle_deg: float, rate_deg_s: float, acceleration_deg_s2: float) -> float:
    """The chamber pressure at which Eq. 24 gives this acceleration, kPa gauge."""
    return (acceleration_deg_s2 - bending_drift(theta, angle_deg, rate_deg_s)) / theta[8]


@kernel(_F8(THETA_TYPE))
def rest_angle(theta: np.ndarray) -> float:
    """The angle at zero gauge pressure, where a(y) y = d, by Newton's method; deg."""
    angle = 20.0
    for _ in range(50):
        angle -= bending_drift(theta, angle, 0.0) / drift_slope_angle(theta, angle, 0.0)
    return angle
