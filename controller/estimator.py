"""From samples of the past to the state at which the command will act.

A sample is old by its age and by the declared lag of its sensor; a command acts after the declared delay of its way. Between
the two the model runs on, with the currents that were sent meanwhile: prediction over the measured age, not over a constant.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from softloop.controller.records import CONFIG_TYPE, INPUTS_TYPE, MEASUREMENT_TYPE, STATE_TYPE
from softloop.dynamics.bending import bending_acceleration
from softloop.dynamics.parameters import MODEL_TYPE, THETA_TYPE
from softloop.dynamics.pneumatics import pressure_rate
from softloop.wire.kernel import kernel

_F8 = types.f8
_STEP_S = 1e-3  # Euler steps: over a few ms at these rates the step's error is far below a sensor's
_LONGEST_S = 0.1  # older samples are not carried on: the gate stops the rig long before


@kernel(_F8(MODEL_TYPE, THETA_TYPE, _F8, _F8, _F8, _F8, _F8))
def pressure_after(
    model: Any, theta: np.ndarray, supply_kpa: float, chamber_kpa: float, charge_ma: float, exhaust_ma: float, seconds: float
) -> float:
    """The chamber pressure after `seconds` of these currents, by the model; kPa."""
    steps = int(seconds / _STEP_S) + 1
    step = seconds / steps
    for _ in range(steps):
        chamber_kpa += step * pressure_rate(model, theta, supply_kpa, chamber_kpa, charge_ma, exhaust_ma)
        chamber_kpa = max(chamber_kpa, 0.0)
    return chamber_kpa


@kernel(types.void(CONFIG_TYPE, MODEL_TYPE, INPUTS_TYPE, STATE_TYPE, MEASUREMENT_TYPE))
def _carry_on(config: Any, model: Any, inputs: Any, state: Any, measurement: Any) -> None:
    """Pressure first, under the commands of the last two ticks, then the angle under that pressure."""
    theta, supply = state.theta, measurement.supply_kpa
    lead = 1e-9 * config.actuation_delay_ns
    pressure_age = min(max(1e-9 * (inputs.now_ns - inputs.pressure.stamp_ns + config.pressure_delay_ns), 0.0), _LONGEST_S)
    angle_age = min(max(1e-9 * (inputs.now_ns - inputs.inclination.stamp_ns + config.inclination_delay_ns), 0.0), _LONGEST_S)
    before = measurement.chamber_kpa
    # A command acts `lead` after its tick: until then the one before the last is in force, from then on the last.
    older = min(pressure_age, max(0.0, pressure_age + lead - measurement.period_s))
    chamber = pressure_after(model, theta, supply, before, state.charge_before_ma, state.exhaust_before_ma, older)
    chamber = pressure_after(model, theta, supply, chamber, state.charge_ma, state.exhaust_ma, pressure_age + lead - older)
    span = angle_age + lead
    steps = int(span / _STEP_S) + 1
    step = span / steps
    angle, rate = measurement.angle_deg, measurement.rate_deg_s
    slope = (chamber - before) / max(pressure_age + lead, 1e-4)
    for k in range(steps):
        since_start = span - k * step  # seconds before the time of action
        pressure = chamber - slope * min(since_start, pressure_age + lead)
        rate += step * bending_acceleration(theta, angle, rate, pressure)
        angle += step * rate
    measurement.angle_deg = angle
    measurement.rate_deg_s = rate
    measurement.chamber_kpa = chamber


@kernel(types.void(CONFIG_TYPE, INPUTS_TYPE, STATE_TYPE, MEASUREMENT_TYPE))
def read_samples(config: Any, inputs: Any, state: Any, measurement: Any) -> None:
    """Fill `measurement` with the newest samples as they are."""
    measurement.angle_deg = inputs.inclination.angle_deg
    measurement.rate_deg_s = inputs.inclination.rate_deg_s
    measurement.chamber_kpa = inputs.pressure.chamber_pressure_kpa
    measurement.supply_kpa = inputs.pressure.supply_pressure_kpa
    elapsed_ns = inputs.now_ns - state.last_ns
    measurement.period_s = 1e-9 * (elapsed_ns if state.last_ns > 0 else config.period_ns)
    measurement.disturbance_deg_s2, measurement.trust = 0.0, 1.0


@kernel(types.void(CONFIG_TYPE, MODEL_TYPE, INPUTS_TYPE, STATE_TYPE, MEASUREMENT_TYPE))
def measure(config: Any, model: Any, inputs: Any, state: Any, measurement: Any) -> None:
    """Fill `measurement` from the newest samples, carried on to the time of action where `config.predict` is set."""
    read_samples(config, inputs, state, measurement)
    if config.predict:
        _carry_on(config, model, inputs, state, measurement)
