"""A wrong sign in the law breaks the identity under Eq. 49: the property catches what a run might hide.

With true parameters and robust terms of no weight, V2' = -K1 S1^2 - rho K2 S2^2 holds exactly.
"""

from pathlib import Path

import numpy as np
import pytest

from softloop.controller import actuation
from softloop.controller.config import ControllerConfig
from softloop.controller.laws import arc
from softloop.controller.records import CONTROLLER_STATE, DEMAND, MEASUREMENT, MODE_CHARGE, MODE_HOLD, REFERENCE
from softloop.controller.robust import projected_rate
from softloop.controller.setup import gains_record
from softloop.dynamics.bending import bending_acceleration
from softloop.dynamics.parameters import (
    B0,
    KV1_CHARGE,
    KV1_EXHAUST,
    KV6_CHARGE,
    KV6_EXHAUST,
    LEAK,
    load_parameters,
    model_record,
    shipped,
)
from softloop.dynamics.pneumatics import known_terms
from softloop.wire.kernel import new_record

MODEL = model_record(load_parameters(shipped()))
SOURCE = Path(arc.__file__).read_text(encoding="utf-8")
SIGNS = (
    ("ahead = (-bending_drift(theta, y, v) - w)", "ahead = (-bending_drift(theta, y, v) + w)"),
    ("wanted = ahead - (gains.k1 * s1", "wanted = ahead + (gains.k1 * s1"),
    ("nominal = moving - theta[B0] * first.s1 / g.rho", "nominal = moving + theta[B0] * first.s1 / g.rho"),
    ("feedback = -gains.k2 * s2 +", "feedback = gains.k2 * s2 +"),
    ("first.by_rate * estimated + first.by_time", "first.by_rate * estimated - first.by_time"),
    ("total -= first.by_ahead", "total += first.by_ahead"),
)


def plain(source):
    """The law's module, its functions not compiled."""
    space = {"__name__": "law"}
    text = source.replace("import kernel, record_dtype", "import record_dtype")
    exec(compile("kernel = lambda *signatures: lambda function: function\n" + text.replace(FUTURE, ""), "law", "exec"), space)
    return space


FUTURE = "from __future__ import annotations\n"


def gains():
    config = ControllerConfig()
    changes = {"gamma": 1e-4, "gamma_valve": 1e-4, "epsilon1": 1e18, "epsilon2": 1e18, "rate_limit": 1e9, "desired_max_kpa": 1e6}
    record = gains_record(config.model_copy(update={"arc": config.arc.model_copy(update=changes)}), MODEL)
    record.actuation.flow_hold_kpa_s, record.actuation.rate_still_deg_s, record.actuation.switch_ticks = 0.0, -1.0, 1
    return record


def excess(law, rng, g):
    """How far V2' is from -K1 S1^2 - rho K2 S2^2 in one random state, in parts of what is compared."""
    measurement, reference = new_record(MEASUREMENT), new_record(REFERENCE)
    measurement.angle_deg, measurement.rate_deg_s = rng.uniform(30, 140), rng.uniform(-100, 100)
    measurement.chamber_kpa, measurement.supply_kpa, measurement.period_s = rng.uniform(10, 120), 200.0, 0.005
    measurement.adapt = 1
    reference.value = measurement.angle_deg + rng.uniform(-5, 5)
    reference.rate, reference.acceleration, reference.jerk = (rng.uniform(-b, b) for b in (80, 300, 1000))
    width = MODEL.theta_max - MODEL.theta_min
    state = np.zeros(1, CONTROLLER_STATE)[0]
    state.theta[:] = MODEL.theta_min + rng.uniform(size=width.size) * width
    state.mode = MODE_HOLD
    for place in (B0, KV1_CHARGE, KV1_EXHAUST):  # where feedback is not enlarged
        state.theta[place] = MODEL.theta_min[place]
    hat = state.theta.copy()
    first, demand = new_record(arc.STEP1), new_record(DEMAND)
    law["arc_step"](MODEL, measurement, reference, g, state, first, demand)
    if demand.mode == MODE_HOLD or first.limited:
        return 0.0
    return _excess_of(measurement, reference, g, state, hat, hat, first, demand)


def _excess_of(m, reference, g, state, hat, true, first, demand):
    charging = demand.mode == MODE_CHARGE
    k1, k6 = (KV1_CHARGE, KV6_CHARGE) if charging else (KV1_EXHAUST, KV6_EXHAUST)
    f1, f2, f3 = known_terms(MODEL, charging, m.supply_kpa, m.chamber_kpa)
    flow = demand.flow_kpa_s + f3 * hat[LEAK]
    current = actuation.current_for_flow(MODEL, hat, charging, m.supply_kpa, m.chamber_kpa, flow)
    pressure_rate = f1 * (true[k1] * current - true[k6]) + f2 - f3 * true[LEAK]
    acceleration = bending_acceleration(true, m.angle_deg, m.rate_deg_s, m.chamber_kpa)
    rates = [
        projected_rate(hat[i], g.arc.gamma[i] * state.arc.tau[i], 1e30, MODEL.theta_min[i], MODEL.theta_max[i])
        for i in range(B0 + 1)
    ]
    by_theta = -state.arc.phi[: B0 + 1] / hat[B0] * first.by_ahead
    # P_vd's own rate by differences of the true law, so that a wrong derivative in the mutant does not hide itself.
    desired_rate = true_rate(m, reference, hat, g, acceleration) + by_theta @ rates
    error = m.angle_deg - reference.value
    s1 = m.rate_deg_s - reference.rate + g.arc.k_s * error
    s1_rate = acceleration - reference.acceleration + g.arc.k_s * (m.rate_deg_s - reference.rate)
    s2 = m.chamber_kpa - true_desired(m, reference, hat, g)
    v2_rate = s1 * s1_rate + g.arc.rho * s2 * (pressure_rate - desired_rate)
    decay = g.arc.k1 * s1**2 + g.arc.rho * g.arc.k2 * s2**2
    return abs(v2_rate + decay) / (abs(decay) + abs(v2_rate) + 1.0)


def true_desired(m, reference, theta, g):
    first = new_record(arc.STEP1)
    arc.first_step(MODEL, g.arc, theta, np.zeros(theta.size), m, reference, first)
    return first.desired


def true_rate(m, reference, theta, g, acceleration, step=1e-6):
    ends = []
    for sign in (1, -1):
        moved, point, t = m.copy(), reference.copy(), sign * step
        moved.angle_deg, moved.rate_deg_s = m.angle_deg + t * m.rate_deg_s, m.rate_deg_s + t * acceleration
        point.value, point.rate = reference.value + t * reference.rate, reference.rate + t * reference.acceleration
        point.acceleration = reference.acceleration + t * reference.jerk
        ends.append(true_desired(moved, point, theta, g))
    return (ends[0] - ends[1]) / (2 * step)


def share_off(source):
    """The part of random states in which the identity is off by more than differences across a kink of |.| can be."""
    law, rng, g = plain(source), np.random.RandomState(5), gains()
    return np.mean([excess(law, rng, g) > 1e-3 for _ in range(300)])


def test_the_law_as_it_is_keeps_the_identity():
    assert share_off(SOURCE) < 0.02


@pytest.mark.parametrize(("right", "wrong"), SIGNS)
def test_a_wrong_sign_breaks_it(right, wrong):
    assert SOURCE.count(right) == 1
    assert share_off(SOURCE.replace(right, wrong)) > 0.2
