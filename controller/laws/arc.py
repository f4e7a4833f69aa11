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
from softloop.dynamics.parameters import THETA_TYPE, B0, KV1_CHARGE, KV1_EXHAUST, KV6_CHARGE, KV6_EXHAUST, LEAK, MODEL_TYPE
from softloop.dynamics.pneumatics import known_terms
from softloop.wire.kernel import array_of, kernel, record_dtype, record_type

_F8 = types.f8

# Step 1 in numbers: the desired pressure and its partial derivatives (Eq. 42).
STEP1 = record_dtype(
    [(n, "f8") for n in ("error", "s1", "desired", "feedforward", "by_angle", "by_rate", "by_time", "bound", "saturated")]
)
STEP1_TYPE = record_type(STEP1)


@kernel(types.void(MODEL_TYPE, ARC_GAINS_TYPE, THETA_TYPE, _F8, THETA_TYPE, MEASUREMENT_TYPE, REFERENCE_TYPE, STEP1_TYPE))
def first_step(
    model: Any, gains: Any, theta: np.ndarray, b0_min: float, phi: np.ndarray, measurement: Any, reference: Any, out: Any
) -> None:
    """Eqs. 33 to 39: S1, P_vd and its partial derivatives; fills phi_b into the first nine places of `phi`."""
    y, v = measurement.angle_deg, measurement.rate_deg_s
    drift_y, drift_v = drift_slope_angle(theta, y, v), drift_slope_rate(theta, y)
    error = y - reference.value
    s1 = v - reference.rate + gains.k_s * error  # Eq. 33
    s1_t = -reference.acceleration - gains.k_s * reference.rate
    w = gains.k_s * (v - reference.rate) - reference.acceleration  # Eq. 34
    w_t = -gains.k_s * reference.acceleration - reference.jerk
    ahead = (-bending_drift(theta, y, v) - w) / theta[B0]  # P_vda, Eq. 36
    ahead_y, ahead_v, ahead_t = -drift_y / theta[B0], (-drift_v - gains.k_s) / theta[B0], -w_t / theta[B0]
    fill_phi_a(y, v, phi)
    phi[B0] = ahead
    # h1 >= theta_M^T |phi_b| + delta_1, Eq. 38. It is a bound: its own change is slow beside S1's and is left out of P_vd'.
    bound = gains.delta1
    for i in range(B0 + 1):
        bound += (model.theta_max[i] - model.theta_min[i]) * abs(phi[i])
    through = tanh(SMOOTH * bound * s1 / gains.epsilon1)
    robust_slope = bound * (1.0 - through * through) * SMOOTH * bound / gains.epsilon1
    feedback_slope = -(gains.k1 + robust_slope) / b0_min  # of P_vds1 + P_vds2, Eqs. 37 and 38, by S1
    wanted = ahead + (-gains.k1 * s1 - bound * through) / b0_min
    out.desired = min(max(wanted, 0.0), gains.desired_max_kpa)
    out.saturated = wanted != out.desired
    inside = 0.0 if wanted != out.desired else 1.0  # at a limit P_vd does not move
    out.error, out.s1, out.feedforward, out.bound = error, s1, ahead, bound
    out.by_angle = inside * (ahead_y + feedback_slope * gains.k_s)
    out.by_rate = inside * (ahead_v + feedback_slope)
    out.by_time = inside * (ahead_t + feedback_slope * s1_t)


@kernel(_F8(MODEL_TYPE, ARC_GAINS_TYPE, STATE_TYPE, MEASUREMENT_TYPE, STEP1_TYPE, _F8, types.b1))
def estimate_rate_term(model: Any, gains: Any, state: Any, measurement: Any, first: Any, s2: float, adapt: bool) -> float:
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
        if adapt:
            rate = projected_rate(
                theta[i], gains.gamma[i] * tau[i], gains.rate_limit[i], model.theta_min[i], model.theta_max[i]
            )
            total -= phi[i] / theta[B0] * rate  # dP_vda/dtheta_i = -phi_i / theta_9 for all nine
    return 0.0 if first.saturated else total


@kernel(types.void(MODEL_TYPE, ARC_GAINS_TYPE, STATE_TYPE, MEASUREMENT_TYPE, _F8, _F8, types.i8))
def valve_regressor(model: Any, gains: Any, state: Any, measurement: Any, flow: float, s2: float, mode: int) -> None:
    """The last places of tau, Eq. 48 with rho: those of the open valve and of the leak; zero in hold (Mode 3)."""
    tau = state.arc.tau
    for i in range(KV1_CHARGE, KV6_EXHAUST + 1):
        tau[i] = 0.0
    if mode == MODE_HOLD:
        return
    charging = mode == MODE_CHARGE
    f1, _, f3 = known_terms(model, charging, measurement.supply_kpa, measurement.chamber_kpa)
    wanted = flow + f3 * state.theta[LEAK]
    current = current_for_flow(model, state.theta, charging, measurement.supply_kpa, measurement.chamber_kpa, wanted)
    k_v1, k_v6 = (KV1_CHARGE, KV6_CHARGE) if charging else (KV1_EXHAUST, KV6_EXHAUST)
    tau[k_v1] = gains.rho * f1 * current * s2
    tau[k_v6] = -gains.rho * f1 * s2
    tau[LEAK] = -gains.rho * f3 * s2


@kernel(types.void(MODEL_TYPE, MEASUREMENT_TYPE, REFERENCE_TYPE, GAINS_TYPE, STATE_TYPE, STEP1_TYPE, DEMAND_TYPE))
def arc_step(
    model: Any, measurement: Any, reference: Any, gains: Any, state: Any, first: Any, demand: Any
) -> None:
    """One step of C3; fills `demand` and moves the estimates in `state.theta`. `first` is scratch."""
    g, theta = gains.arc, state.theta
    adapt = measurement.adapt != 0
    first_step(model, g, theta, model.theta_min[B0], state.arc.phi, measurement, reference, first)
    s2 = measurement.chamber_kpa - first.desired
    estimated = bending_drift(theta, measurement.angle_deg, measurement.rate_deg_s) + theta[B0] * measurement.chamber_kpa
    moving = first.by_angle * measurement.rate_deg_s + first.by_rate * estimated + first.by_time  # Eq. 42, corrected
    moving += estimate_rate_term(model, g, state, measurement, first, s2, adapt)
    nominal = moving - theta[B0] * first.s1 / g.rho  # the flow of I_ia, Eq. 45
    bound = g.delta2 + abs(first.by_rate) * g.delta1  # h2 of Eq. 47 less the valve's part, which adaptation carries
    demand.flow_kpa_s = nominal - g.k2 * s2 + robust_term(bound, s2, g.epsilon2)  # with Eqs. 44 and 46
    demand.desired_pressure_kpa, demand.error, demand.s1, demand.s2 = first.desired, first.error, first.s1, s2
    demand.mode = choose_mode(gains.actuation, reference, first.error, demand.flow_kpa_s, state)
    valve_regressor(model, g, state, measurement, nominal, s2, demand.mode)
    if adapt:
        for i in range(theta.size):
            rate = g.gamma[i] * state.arc.tau[i]
            theta[i] = adapted(theta[i], rate, g.rate_limit[i], model.theta_min[i], model.theta_max[i], measurement.period_s)
