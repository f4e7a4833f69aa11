"""Ours: weighted backstepping on the observer's state, with its disturbance in place of robust terms and wide bounds.

The steps are those of C3 (Eqs. 33 to 48). What differs: Delta_1 is not bounded but estimated (sigma, from the gyro), and
compensated in P_vda; Delta_2 is estimated per valve and compensated where flow becomes current (`valve_drive`); so both steps
need feedback for what the estimates still lack, and no more. Adaptation, where it is switched on, is composite: it is driven
by the observer's residual of Eq. 2, sigma itself, and its rate is cancelled in P_vd' as C3's is.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from softloop.controller.actuation import choose_mode
from softloop.controller.laws.arc import STEP1_TYPE
from softloop.controller.records import (
    ARC_ESO_GAINS_TYPE,
    DEMAND_TYPE,
    GAINS_TYPE,
    MEASUREMENT_TYPE,
    REFERENCE_TYPE,
    STATE_TYPE,
)
from softloop.controller.robust import adapted, projected_rate
from softloop.dynamics.bending import bending_drift, drift_slope_angle, drift_slope_rate, fill_phi_a
from softloop.dynamics.parameters import B0, MODEL_TYPE, THETA_TYPE
from softloop.wire.kernel import kernel

_F8 = types.f8


@kernel(types.void(ARC_ESO_GAINS_TYPE, _F8, THETA_TYPE, MEASUREMENT_TYPE, REFERENCE_TYPE, STEP1_TYPE))
def desired_pressure(gains: Any, k1: float, theta: np.ndarray, measurement: Any, reference: Any, out: Any) -> None:
    """S1 (Eq. 33), P_vd (Eqs. 35 to 37 with sigma) and its partial derivatives."""
    y, v, b0 = measurement.angle_deg, measurement.rate_deg_s, theta[B0]
    error = y - reference.value
    error_rate = v - reference.rate
    s1 = error_rate + gains.k_s * error
    drift = bending_drift(theta, y, v) + measurement.disturbance_deg_s2
    ahead = (reference.acceleration - gains.k_s * error_rate - drift) / b0
    wanted = ahead - k1 * s1 / b0
    out.desired = min(max(wanted, 0.0), gains.desired_max_kpa)
    out.limited = wanted != out.desired
    out.error, out.s1, out.ahead, out.bound = error, s1, ahead, 0.0
    moves = 0.0 if wanted != out.desired else 1.0  # at its limit P_vd does not move
    out.by_ahead = moves
    out.by_angle = moves * (-drift_slope_angle(theta, y, v) - k1 * gains.k_s) / b0
    out.by_rate = moves * (-drift_slope_rate(theta, y) - gains.k_s - k1) / b0
    out.by_time = moves * (reference.jerk + (gains.k_s + k1) * reference.acceleration + k1 * gains.k_s * reference.rate) / b0


@kernel(_F8(MODEL_TYPE, ARC_ESO_GAINS_TYPE, STATE_TYPE, MEASUREMENT_TYPE, STEP1_TYPE))
def adapt_by_residual(model: Any, gains: Any, state: Any, measurement: Any, first: Any) -> float:
    """Move the mechanics' estimates along phi_b sigma, projected; returns dP_vd/dtheta_b times their rate, kPa/s."""
    theta, phi, total = state.theta, state.arc.phi, 0.0
    fill_phi_a(measurement.angle_deg, measurement.rate_deg_s, phi)
    phi[B0] = measurement.chamber_kpa
    for i in range(B0 + 1):
        tau = phi[i] * measurement.disturbance_deg_s2
        state.arc.tau[i] = tau
        low, high = model.theta_min[i], model.theta_max[i]
        rate = projected_rate(theta[i], gains.gamma[i] * tau, gains.rate_limit[i], low, high)
        total -= first.by_ahead * (first.ahead if i == B0 else phi[i]) / theta[B0] * rate
        theta[i] = adapted(theta[i], gains.gamma[i] * tau, gains.rate_limit[i], low, high, measurement.period_s)
    return total


@kernel(types.void(MODEL_TYPE, MEASUREMENT_TYPE, REFERENCE_TYPE, GAINS_TYPE, STATE_TYPE, STEP1_TYPE, DEMAND_TYPE))
def arc_eso_step(model: Any, measurement: Any, reference: Any, gains: Any, state: Any, first: Any, demand: Any) -> None:
    """One step; fills `demand`. `first` is scratch."""
    g, theta = gains.arc_eso, state.theta
    caution = g.cautious + (1.0 - g.cautious) * measurement.trust
    k1, k2 = caution * g.k1, caution * g.k2
    desired_pressure(g, k1, theta, measurement, reference, first)
    s2 = measurement.chamber_kpa - first.desired
    acceleration = bending_drift(theta, measurement.angle_deg, measurement.rate_deg_s) + measurement.disturbance_deg_s2
    acceleration += theta[B0] * measurement.chamber_kpa
    moving = first.by_angle * measurement.rate_deg_s + first.by_rate * acceleration + first.by_time  # Eq. 42, corrected
    if measurement.adapt and measurement.trust >= 1.0 and g.gamma[0] > 0.0:
        moving += adapt_by_residual(model, g, state, measurement, first)
    demand.flow_kpa_s = moving - theta[B0] * first.s1 / g.rho - k2 * s2
    demand.desired_pressure_kpa, demand.error, demand.s1, demand.s2 = first.desired, first.error, first.s1, s2
    demand.mode = choose_mode(gains.actuation, reference, first.error, demand.flow_kpa_s, state)
