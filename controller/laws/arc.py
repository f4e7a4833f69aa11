"""C3: the adaptive robust controller, Eqs. 33 to 48 as corrected, with the weight rho of S2 in V2 = V1 + rho S2^2 / 2.

With rho = 1 and the modes of Table 2 this is the paper's text. Two things differ from what is printed, and both are needed
for its proof: the rate of the parameter estimates in P_vd' is computed and cancelled (Eq. 43 calls it incalculable; it does
not contain I_ia), and the cross term -theta_9 S1 is divided by rho.
"""

from __future__ import annotations

from math import tanh
from typing import Any

import numpy as np
from numba import types

from softloop.controller.actuation import choose_mode, current_for_flow
from softloop.controller.records import (
    ACTUATION_TYPE,
    ARC_GAINS_TYPE,
    DEMAND_TYPE,
    GAINS_TYPE,
    MEASUREMENT_TYPE,
    MODE_CHARGE,
    MODE_HOLD,
    REFERENCE_TYPE,
    STATE_TYPE,
)
from softloop.controller.robust import SMOOTH, adapted, projected_rate, robust_term
from softloop.dynamics.bending import bending_drift, drift_slope_angle, drift_slope_rate, fill_phi_a
from softloop.dynamics.parameters import B0, KV1_CHARGE, KV1_EXHAUST, KV6_CHARGE, KV6_EXHAUST, LEAK, MODEL_TYPE, THETA_TYPE
from softloop.dynamics.pneumatics import known_terms
from softloop.wire.kernel import kernel, record_dtype, record_type

_F8 = types.f8

# Step 1 in numbers: the desired pressure and its partial derivatives (Eq. 42).
STEP1 = record_dtype(
    [(n, "f8") for n in ("error", "s1", "desired", "ahead", "by_angle", "by_rate", "by_time", "by_ahead", "bound", "limited")]
)
STEP1_TYPE = record_type(STEP1)


@kernel(types.UniTuple(_F8, 3)(MODEL_TYPE, _F8, _F8))
def mechanics_bound(model: Any, angle_deg: float, rate_deg_s: float) -> tuple[float, float, float]:
    """theta_M^T |phi_a| of Eq. 38 and its derivatives by angle and rate; theta_M is the width of the bounds."""
    y, v = abs(angle_deg), abs(rate_deg_s)
    sign_y, sign_v = np.sign(angle_deg), np.sign(rate_deg_s)
    m = model.theta_max - model.theta_min
    still = y * (m[0] + y * (m[1] + y * m[2]))
    still_y = m[0] + y * (2.0 * m[1] + 3.0 * y * m[2])
    per_rate = m[3] + y * (m[4] + y * (m[5] + y * m[6]))
    per_rate_y = m[4] + y * (2.0 * m[5] + 3.0 * y * m[6])
    return still + per_rate * v + m[7], sign_y * (still_y + per_rate_y * v), sign_v * per_rate


@kernel(types.void(MODEL_TYPE, ARC_GAINS_TYPE, THETA_TYPE, THETA_TYPE, MEASUREMENT_TYPE, REFERENCE_TYPE, STEP1_TYPE))
def first_step(model: Any, gains: Any, theta: np.ndarray, phi: np.ndarray, measurement: Any, reference: Any, out: Any) -> None:
    """Eqs. 33 to 39: S1, P_vd and its partial derivatives; fills phi_b into the first nine places of `phi`."""
    y, v = measurement.angle_deg, measurement.rate_deg_s
    error = y - reference.value
    s1 = v - reference.rate + gains.k_s * error  # Eq. 33
    w = gains.k_s * (v - reference.rate) - reference.acceleration  # Eq. 34
    ahead = (-bending_drift(theta, y, v) - w) / theta[B0]  # P_vda, Eq. 36
    fill_phi_a(y, v, phi)
    phi[B0] = ahead
    b0_min = model.theta_min[B0]
    b0_width = model.theta_max[B0] - b0_min
    known, known_y, known_v = mechanics_bound(model, y, v)
    bound = gains.delta1 + known + b0_width * abs(ahead)  # h1 >= theta_M^T |phi_b| + delta_1
    u = SMOOTH * bound * s1 / gains.epsilon1
    smooth, steep = tanh(u), 1.0 - tanh(u) ** 2
    wanted = ahead - (gains.k1 * s1 + bound * smooth) / b0_min  # Eqs. 35, 37, 38
    out.desired = min(max(wanted, 0.0), gains.desired_max_kpa)
    out.limited = wanted != out.desired
    out.error, out.s1, out.ahead, out.bound = error, s1, ahead, bound
    moves = 0.0 if wanted != out.desired else 1.0  # at its limit P_vd does not move
    by_s1 = -moves * (gains.k1 + steep * SMOOTH * bound * bound / gains.epsilon1) / b0_min
    by_bound = -moves * (smooth + u * steep) / b0_min
    out.by_ahead = moves + by_bound * b0_width * np.sign(ahead)
    ahead_y = -drift_slope_angle(theta, y, v) / theta[B0]
    ahead_v = (-drift_slope_rate(theta, y) - gains.k_s) / theta[B0]
    ahead_t = (gains.k_s * reference.acceleration + reference.jerk) / theta[B0]
    out.by_angle = out.by_ahead * ahead_y + by_bound * known_y + by_s1 * gains.k_s
    out.by_rate = out.by_ahead * ahead_v + by_bound * known_v + by_s1
    out.by_time = out.by_ahead * ahead_t - by_s1 * (reference.acceleration + gains.k_s * reference.rate)


@kernel(_F8(MODEL_TYPE, ARC_GAINS_TYPE, STATE_TYPE, MEASUREMENT_TYPE, STEP1_TYPE, _F8))
def estimate_rate_term(model: Any, gains: Any, state: Any, measurement: Any, first: Any, s2: float) -> float:
    """dP_vd/dtheta_b times the rate of theta_b (Eq. 43's second part), kPa/s; leaves tau's first nine places in the state.

    tau is Eq. 48 with rho: phi_b S1 + rho phi_c S2 for the mechanics' parameters, which holds no current.
    """
    theta, phi, tau = state.theta, state.arc.phi, state.arc.tau
    total = 0.0
    for i in range(B0 + 1):
        regressor = measurement.chamber_kpa if i == B0 else phi[i]
        tau[i] = phi[i] * first.s1 - gains.rho * first.by_rate * regressor * s2
        if i == B0:
            tau[i] += first.s1 * s2
        if measurement.adapt:
            rate = projected_rate(theta[i], gains.gamma[i] * tau[i], gains.rate_limit[i], model.theta_min[i], model.theta_max[i])
            total -= first.by_ahead * phi[i] / theta[B0] * rate  # dP_vda/dtheta_i = -phi_i / theta_9 for all nine
    return total


@kernel(_F8(MODEL_TYPE, ARC_GAINS_TYPE, STATE_TYPE, MEASUREMENT_TYPE, STEP1_TYPE, _F8, _F8, types.i8))
def second_step(model: Any, gains: Any, state: Any, measurement: Any, first: Any, nominal: float, s2: float, mode: int) -> float:
    """Eqs. 44 to 48 in an open mode: the flow asked of the valve, kPa/s; fills the valve's places of tau.

    `nominal` is the flow of I_ia (Eq. 45). I_is1 and I_is2 are divided by theta_10min, so their flow grows by theta_10 over it.
    """
    theta, tau, phi = state.theta, state.arc.tau, state.arc.phi
    charging = mode == MODE_CHARGE
    k_v1, k_v6 = (KV1_CHARGE, KV6_CHARGE) if charging else (KV1_EXHAUST, KV6_EXHAUST)
    f1, _, f3 = known_terms(model, charging, measurement.supply_kpa, measurement.chamber_kpa)
    wanted = nominal + f3 * theta[LEAK]
    current = current_for_flow(model, theta, charging, measurement.supply_kpa, measurement.chamber_kpa, wanted)
    width = model.theta_max - model.theta_min
    bound = gains.delta2 + abs(first.by_rate) * gains.delta1  # h2 of Eq. 47
    for i in range(B0):
        bound += width[i] * abs(first.by_rate * phi[i])
    bound += width[B0] * abs(first.s1 / gains.rho - first.by_rate * measurement.chamber_kpa)
    bound += abs(f1) * (width[k_v1] * abs(current) + width[k_v6]) + f3 * width[LEAK]
    tau[k_v1] = gains.rho * f1 * current * s2
    tau[k_v6] = -gains.rho * f1 * s2
    tau[LEAK] = -gains.rho * f3 * s2
    feedback = -gains.k2 * s2 + robust_term(bound, s2, gains.epsilon2)
    return nominal + theta[k_v1] / model.theta_min[k_v1] * feedback


@kernel(
    types.void(
        MODEL_TYPE, MEASUREMENT_TYPE, REFERENCE_TYPE, ACTUATION_TYPE, ARC_GAINS_TYPE, STATE_TYPE, STEP1_TYPE, DEMAND_TYPE
    )
)  # fmt: skip
def backstep(model: Any, measurement: Any, reference: Any, actuation: Any, g: Any, state: Any, first: Any, demand: Any) -> None:
    """Both steps with the gains `g`; moves the estimates where `measurement.adapt` is set. `first` is scratch."""
    theta = state.theta
    first_step(model, g, theta, state.arc.phi, measurement, reference, first)
    s2 = measurement.chamber_kpa - first.desired
    estimated = bending_drift(theta, measurement.angle_deg, measurement.rate_deg_s) + theta[B0] * measurement.chamber_kpa
    moving = first.by_angle * measurement.rate_deg_s + first.by_rate * estimated + first.by_time  # Eq. 42, corrected
    moving += estimate_rate_term(model, g, state, measurement, first, s2)
    nominal = moving - theta[B0] * first.s1 / g.rho  # the flow of I_ia, Eq. 45
    demand.flow_kpa_s = nominal - g.k2 * s2
    demand.desired_pressure_kpa, demand.error, demand.s1, demand.s2 = first.desired, first.error, first.s1, s2
    demand.mode = choose_mode(actuation, reference, first.error, demand.flow_kpa_s, state)
    for i in range(KV1_CHARGE, KV6_EXHAUST + 1):
        state.arc.tau[i] = 0.0  # a closed valve teaches nothing (Mode 3, or the other one)
    if demand.mode != MODE_HOLD:
        demand.flow_kpa_s = second_step(model, g, state, measurement, first, nominal, s2, demand.mode)
    if measurement.adapt:
        for i in range(theta.size):
            rate = g.gamma[i] * state.arc.tau[i]
            theta[i] = adapted(theta[i], rate, g.rate_limit[i], model.theta_min[i], model.theta_max[i], measurement.period_s)


@kernel(types.void(MODEL_TYPE, MEASUREMENT_TYPE, REFERENCE_TYPE, GAINS_TYPE, STATE_TYPE, STEP1_TYPE, DEMAND_TYPE))
def arc_step(model: Any, measurement: Any, reference: Any, gains: Any, state: Any, first: Any, demand: Any) -> None:
    """One step of C3; fills `demand` and moves the estimates in `state.theta`. `first` is scratch."""
    backstep(model, measurement, reference, gains.actuation, gains.arc, state, first, demand)
