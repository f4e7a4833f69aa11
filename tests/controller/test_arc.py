"""The algebra of the law over random states: Eqs. 31, 32, 38, 42, 47 and 49 as corrected."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from softloop.controller.actuation import current_for_flow
from softloop.controller.config import ControllerConfig
from softloop.controller.laws.arc import STEP1, arc_step, first_step
from softloop.controller.records import CONTROLLER_STATE, DEMAND, MEASUREMENT, MODE_CHARGE, MODE_HOLD, REFERENCE
from softloop.controller.robust import adapted, projected_rate, robust_term
from softloop.controller.setup import gains_record
from softloop.dynamics.bending import bending_acceleration
from softloop.dynamics.parameters import (
    B0,
    KV1_CHARGE,
    KV1_EXHAUST,
    KV6_CHARGE,
    KV6_EXHAUST,
    LEAK,
    N_THETA,
    load_parameters,
    model_record,
    shipped,
)
from softloop.dynamics.pneumatics import known_terms
from softloop.wire.kernel import new_record

MODEL = model_record(load_parameters(shipped()))
UNIT = st.floats(0.0, 1.0)
BOX = st.lists(UNIT, min_size=N_THETA, max_size=N_THETA)


def in_box(shares):
    return MODEL.theta_min + np.array(shares) * (MODEL.theta_max - MODEL.theta_min)


def gains(**changes):
    config = ControllerConfig()
    arc = config.arc.model_copy(update={"gamma": 1e-4, "gamma_valve": 1e-4, "rate_limit": 1e9, "desired_max_kpa": 1e6} | changes)
    record = gains_record(config.model_copy(update={"arc": arc}), MODEL)
    record.actuation.flow_hold_kpa_s = 0.0
    record.actuation.rate_still_deg_s = -1.0
    record.actuation.switch_ticks = 1
    return record


@st.composite
def states(draw):
    measurement, reference = new_record(MEASUREMENT), new_record(REFERENCE)
    measurement.angle_deg = draw(st.floats(30, 140))
    measurement.rate_deg_s = draw(st.floats(-100, 100))
    measurement.chamber_kpa = draw(st.floats(10, 120))
    measurement.supply_kpa = 200.0
    measurement.period_s = 0.005
    measurement.adapt = 1
    reference.value = measurement.angle_deg + draw(st.floats(-5, 5))
    reference.rate, reference.acceleration, reference.jerk = (draw(st.floats(-b, b)) for b in (80, 300, 1000))
    return measurement, reference


def step(measurement, reference, shares, g):
    state = np.zeros(1, CONTROLLER_STATE)[0]
    state.theta[:] = in_box(shares)
    state.mode = MODE_HOLD
    first, demand = new_record(STEP1), new_record(DEMAND)
    before = state.theta.copy()
    arc_step(MODEL, measurement, reference, g, state, first, demand)
    return state, first, demand, before


def desired(measurement, reference, theta, g, dy=0.0, dv=0.0, dt=0.0):
    m, r = new_record(MEASUREMENT), new_record(REFERENCE)
    m.angle_deg, m.rate_deg_s = measurement.angle_deg + dy, measurement.rate_deg_s + dv
    r.value = reference.value + dt * reference.rate
    r.rate = reference.rate + dt * reference.acceleration
    r.acceleration = reference.acceleration + dt * reference.jerk
    r.jerk = reference.jerk
    first = new_record(STEP1)
    first_step(MODEL, g.arc, theta, np.zeros(N_THETA), m, r, first)
    return first


@given(states(), BOX)
def test_the_partial_derivatives_of_the_desired_pressure(state, shares):
    measurement, reference = state
    theta, g, h = in_box(shares), gains(), 1e-5
    at = desired(measurement, reference, theta, g)
    assume(not at.limited)
    assume(abs(at.ahead) > 0.1)
    assume(abs(measurement.rate_deg_s) > 0.1)
    for name, change in (("by_angle", "dy"), ("by_rate", "dv"), ("by_time", "dt")):
        up, down = (desired(measurement, reference, theta, g, **{change: s * h}).desired for s in (1, -1))
        assume(up != 0.0)
        assume(down != 0.0)
        assert at[name] == pytest.approx((up - down) / (2 * h), rel=1e-3, abs=1e-3)


@given(states(), BOX, BOX, st.floats(-1, 1))
def test_condition_38_holds_for_every_true_parameter_in_the_box(state, estimate, truth, disturbance):
    measurement, reference = state
    g = gains()
    theta_hat, theta = in_box(estimate), in_box(truth)
    phi, first = np.zeros(N_THETA), new_record(STEP1)
    first_step(MODEL, g.arc, theta_hat, phi, measurement, reference, first)
    robust = robust_term(first.bound, first.s1, g.arc.epsilon1) / MODEL.theta_min[B0]
    delta1 = disturbance * g.arc.delta1
    assert first.s1 * robust <= 0.0
    mismatch = phi[: B0 + 1] @ (theta_hat - theta)[: B0 + 1]
    assert first.s1 * (theta[B0] * robust - mismatch + delta1) <= g.arc.epsilon1 * (1 + 1e-9)


@settings(max_examples=400)
@given(states(), BOX, BOX, st.sampled_from([1.0, 10.0, 50.0]))
def test_v2_falls_as_eq_49_says_for_every_true_parameter_in_the_box(state, estimate, truth, rho):
    measurement, reference = state
    g = gains(rho=rho)
    after, first, demand, theta_hat = step(measurement, reference, estimate, g)
    assume(demand.mode != MODE_HOLD)
    assume(not first.limited)
    theta = in_box(truth)
    charging = demand.mode == MODE_CHARGE
    k1, k6 = (KV1_CHARGE, KV6_CHARGE) if charging else (KV1_EXHAUST, KV6_EXHAUST)
    f1, f2, f3 = known_terms(MODEL, charging, measurement.supply_kpa, measurement.chamber_kpa)
    flow = demand.flow_kpa_s + f3 * theta_hat[LEAK]
    args = (MODEL, theta_hat, charging, measurement.supply_kpa, measurement.chamber_kpa, flow)
    current = current_for_flow(*args)
    pressure_rate = f1 * (theta[k1] * current - theta[k6]) + f2 - f3 * theta[LEAK]
    acceleration = bending_acceleration(theta, measurement.angle_deg, measurement.rate_deg_s, measurement.chamber_kpa)
    rates = [
        projected_rate(theta_hat[i], g.arc.gamma[i] * after.arc.tau[i], 1e30, MODEL.theta_min[i], MODEL.theta_max[i])
        for i in range(B0 + 1)
    ]
    by_theta = -first.by_ahead * after.arc.phi[: B0 + 1] / theta_hat[B0]
    desired_rate = first.by_angle * measurement.rate_deg_s + first.by_rate * acceleration + first.by_time + by_theta @ rates
    error_rate = measurement.rate_deg_s - reference.rate
    s1_rate = acceleration - reference.acceleration + g.arc.k_s * error_rate
    v2_rate = first.s1 * s1_rate + rho * demand.s2 * (pressure_rate - desired_rate)
    decay = g.arc.k1 * first.s1**2 + rho * g.arc.k2 * demand.s2**2
    allowed = -decay + g.arc.epsilon1 + rho * g.arc.epsilon2
    assert v2_rate <= allowed + 1e-6 * (abs(decay) + abs(v2_rate) + 1.0)


@given(st.floats(-10, 10), st.floats(-1e3, 1e3), st.floats(0.1, 1e3), UNIT, UNIT)
def test_projection_keeps_the_set_and_property_p2(low, rate, limit, share, true_share):
    high = low + 3.0
    value, true = low + share * 3.0, low + true_share * 3.0
    assert low <= adapted(value, rate, limit, low, high, 0.005) <= high
    assert (value - true) * (projected_rate(value, rate, 1e9, low, high) - rate) <= 1e-9


@given(states(), BOX)
def test_estimates_stay_in_their_set_whatever_comes(state, shares):
    measurement, reference = state
    after, *_ = step(measurement, reference, shares, gains(gamma=1e3, gamma_valve=1e3))
    assert np.all(after.theta >= MODEL.theta_min)
    assert np.all(after.theta <= MODEL.theta_max)


@given(states(), BOX)
def test_without_leave_to_adapt_nothing_moves(state, shares):
    measurement, reference = state
    measurement.adapt = 0
    after, _, _, before = step(measurement, reference, shares, gains())
    assert after.theta.tolist() == before.tolist()
