"""The extended state observer: mechanics, disturbance and gyro bias, pressure, and what the valves do beyond their model.

Three chains, each with double poles placed by one bandwidth. The gyro drives rate and disturbance (the state of third order:
angle, rate, disturbance); the angle, slower, drives angle and gyro bias; the pressure drives pressure and one offset per
valve, in mA, or a flow while both are shut, so that a switch of the mode finds again what the other valve had taught.
The observer stands at the stamps of the newest samples; from there the state is carried on to the time of action through the
flows that the commands under way give after all limits: a clamped command is predicted as clamped, so nothing winds up.
"""

from __future__ import annotations

from math import exp
from typing import Any

import numpy as np
from numba import types

from softloop.controller.actuation import opening_current
from softloop.controller.flows import carried, supplied
from softloop.controller.records import (
    CONFIG_TYPE,
    GAINS_TYPE,
    INPUTS_TYPE,
    MEASUREMENT_TYPE,
    MODE_CHARGE,
    MODE_EXHAUST,
    N_FLOWS,
    OBSERVER_GAINS_TYPE,
    OBSERVER_TYPE,
    STATE_TYPE,
)
from softloop.dynamics.parameters import KV1_CHARGE, KV1_EXHAUST, MODEL_TYPE
from softloop.dynamics.pneumatics import known_terms
from softloop.wire.kernel import kernel

_F8 = types.f8
_NS = 1e-9
_LONGEST_S = 0.1  # a sample that comes after a longer silence corrects as after this one
_DISTURBANCE_MAX = 3000.0  # deg/s2; about what full pressure gives
_BIAS_MAX = 10.0  # deg/s
_OFFSET_MAX_MA = 40.0
_HOLD_MAX_KPA_S = 60.0
_FLOW_FLOOR = 5.0e7  # (kPa/s)/m2, as in `actuation`
_STATISTIC_TICKS = 200.0  # memory of the innovation's statistics


@kernel(_F8(_F8, _F8))
def within(value: float, limit: float) -> float:
    """`value` held in [-limit, limit]."""
    return min(max(value, -limit), limit)


@kernel(types.UniTuple(_F8, 2)(_F8, _F8))
def double_pole(bandwidth_1_s: float, seconds: float) -> tuple[float, float]:
    """Gains on a value and on its cause (1/s) that give both poles exp(-bandwidth * seconds)."""
    beta = exp(-bandwidth_1_s * seconds)
    return 1.0 - beta * beta, (1.0 - beta) ** 2 / seconds


@kernel(types.void(INPUTS_TYPE, OBSERVER_TYPE))
def begin_observer(inputs: Any, observer: Any) -> None:
    """Start from the newest samples, with no disturbance, no bias, no offset, no flow."""
    observer.angle_deg, observer.rate_deg_s = inputs.inclination.angle_deg, inputs.inclination.rate_deg_s
    observer.chamber_kpa = inputs.pressure.chamber_pressure_kpa
    observer.disturbance_deg_s2, observer.gyro_bias_deg_s = 0.0, 0.0
    observer.charge_offset_ma, observer.exhaust_offset_ma, observer.hold_kpa_s = 0.0, 0.0, 0.0
    observer.charge_play_ma, observer.exhaust_play_ma = 0.0, 0.0
    observer.innovation_deg_s, observer.innovation_power, observer.innovation_pair = 0.0, 0.0, 0.0
    for j in range(N_FLOWS):
        observer.flow_kpa_s[j] = 0.0
    observer.inclination_ns, observer.pressure_ns = inputs.inclination.stamp_ns, inputs.pressure.stamp_ns


@kernel(types.b1(MODEL_TYPE, _F8, STATE_TYPE))
def valve_open(model: Any, supply_kpa: float, state: Any) -> bool:
    """Whether the valve whose turn it is feels more than its opening current, by model and offset."""
    observer, theta = state.observer, state.theta
    if state.mode == MODE_CHARGE:
        opening = opening_current(model, theta, True, supply_kpa, observer.chamber_kpa)
        return bool(observer.charge_play_ma - observer.charge_offset_ma > opening)
    if state.mode == MODE_EXHAUST:
        opening = opening_current(model, theta, False, supply_kpa, observer.chamber_kpa)
        return bool(observer.exhaust_play_ma - observer.exhaust_offset_ma > opening)
    return False


@kernel(types.void(MODEL_TYPE, OBSERVER_GAINS_TYPE, STATE_TYPE, _F8, _F8, _F8, _F8))
def teach_valve(
    model: Any, gains: Any, state: Any, settled_s: float, period_s: float, supply_kpa: float, flow_kpa_s: float
) -> None:
    """Give a missing flow to the valve that was open when it arose, where only one can have been.

    Near the room's pressure a small missing flow would be a large offset, and a wrong one once the pressure is up again:
    there the exhaust valve learns as at `gains.teach_kpa`.
    """
    observer, theta = state.observer, state.theta
    if state.mode_ticks * period_s < settled_s:
        return
    if not valve_open(model, supply_kpa, state):
        observer.hold_kpa_s = within(observer.hold_kpa_s + flow_kpa_s, _HOLD_MAX_KPA_S)
    elif state.mode == MODE_CHARGE:
        f1, _, _ = known_terms(model, True, supply_kpa, observer.chamber_kpa)
        step = flow_kpa_s / (theta[KV1_CHARGE] * max(f1, _FLOW_FLOOR))
        observer.charge_offset_ma = within(observer.charge_offset_ma - step, _OFFSET_MAX_MA)
    else:
        f1, _, _ = known_terms(model, False, supply_kpa, max(observer.chamber_kpa, gains.teach_kpa))
        step = flow_kpa_s / (theta[KV1_EXHAUST] * min(f1, -_FLOW_FLOOR))
        observer.exhaust_offset_ma = within(observer.exhaust_offset_ma - step, _OFFSET_MAX_MA)


@kernel(types.void(CONFIG_TYPE, MODEL_TYPE, OBSERVER_GAINS_TYPE, INPUTS_TYPE, STATE_TYPE, _F8))
def observe_pressure(config: Any, model: Any, gains: Any, inputs: Any, state: Any, base_s: float) -> None:
    """Bring the pressure to its newest sample and correct it. `base_s`: when the newest command acts, less now."""
    observer, period = state.observer, _NS * config.period_ns
    end = _NS * (inputs.pressure.stamp_ns - inputs.now_ns - config.pressure_delay_ns) - base_s
    seconds = min(_NS * (inputs.pressure.stamp_ns - observer.pressure_ns), _LONGEST_S)
    observer.pressure_ns = inputs.pressure.stamp_ns
    predicted = max(observer.chamber_kpa + supplied(observer, period, end - seconds, end), 0.0)
    error = inputs.pressure.chamber_pressure_kpa - predicted
    observer.chamber_kpa = predicted
    if np.isfinite(error):
        near, cause = double_pole(gains.pressure_1_s, seconds)
        observer.chamber_kpa += near * error
        teach_valve(model, gains, state, seconds - end, period, inputs.pressure.supply_pressure_kpa, cause * error)


@kernel(types.void(OBSERVER_TYPE, _F8))
def note_innovation(observer: Any, innovation: float) -> None:
    """Running power of the innovation, and of its product with the one before: their ratio is 0 where it is white."""
    share = 1.0 / _STATISTIC_TICKS
    observer.innovation_power += share * (innovation * innovation - observer.innovation_power)
    observer.innovation_pair += share * (innovation * observer.innovation_deg_s - observer.innovation_pair)
    observer.innovation_deg_s = innovation


@kernel(types.void(CONFIG_TYPE, OBSERVER_GAINS_TYPE, INPUTS_TYPE, STATE_TYPE, _F8))
def observe_motion(config: Any, gains: Any, inputs: Any, state: Any, base_s: float) -> None:
    """Bring angle, rate and disturbance to the newest sample of the inclinometer and correct them."""
    observer, period = state.observer, _NS * config.period_ns
    end = _NS * (inputs.inclination.stamp_ns - inputs.now_ns - config.inclination_delay_ns) - base_s
    seconds = min(_NS * (inputs.inclination.stamp_ns - observer.inclination_ns), _LONGEST_S)
    observer.inclination_ns = inputs.inclination.stamp_ns
    pressure_at = _NS * (observer.pressure_ns - inputs.now_ns - config.pressure_delay_ns) - base_s
    start = end - seconds
    chamber = observer.chamber_kpa + supplied(observer, period, pressure_at, start - gains.line_s)
    angle, rate, _ = carried(
        observer, state.theta, period, observer.angle_deg, observer.rate_deg_s, chamber, start - gains.line_s, end - gains.line_s
    )
    by_angle = inputs.inclination.angle_deg - angle
    by_rate = inputs.inclination.rate_deg_s - observer.gyro_bias_deg_s - rate
    observer.angle_deg, observer.rate_deg_s = angle, rate
    if np.isfinite(by_angle + by_rate):
        near, cause = double_pole(gains.angle_1_s, seconds)
        observer.angle_deg += near * by_angle
        observer.gyro_bias_deg_s = within(observer.gyro_bias_deg_s - cause * by_angle, _BIAS_MAX)
        near, cause = double_pole(gains.rate_1_s, seconds)
        observer.rate_deg_s += near * by_rate
        observer.disturbance_deg_s2 = within(observer.disturbance_deg_s2 + cause * by_rate, _DISTURBANCE_MAX)
        note_innovation(observer, by_rate)


@kernel(_F8(OBSERVER_GAINS_TYPE, OBSERVER_TYPE))
def trust(gains: Any, observer: Any) -> float:
    """1 while the innovation is white, 0 once its autocorrelation passes `gains.whiteness`; falling from half of that on."""
    if gains.whiteness <= 0.0 or observer.innovation_power <= 0.0:
        return 1.0
    correlation = abs(observer.innovation_pair) / observer.innovation_power
    return min(max(2.0 * (1.0 - correlation / gains.whiteness), 0.0), 1.0)


@kernel(types.void(CONFIG_TYPE, MODEL_TYPE, GAINS_TYPE, INPUTS_TYPE, STATE_TYPE, MEASUREMENT_TYPE))
def observe(config: Any, model: Any, gains: Any, inputs: Any, state: Any, measurement: Any) -> None:
    """Take in what is new, then fill `measurement` with the state at which this tick's command will act."""
    observer, period = state.observer, _NS * config.period_ns
    lead = _NS * config.actuation_delay_ns
    base = _NS * (state.last_ns - inputs.now_ns) + lead  # when the newest command acts, less now
    if inputs.pressure.stamp_ns > observer.pressure_ns:
        observe_pressure(config, model, gains.observer, inputs, state, base)
    if inputs.inclination.stamp_ns > observer.inclination_ns:
        observe_motion(config, gains.observer, inputs, state, base)
    pressure_at = _NS * (observer.pressure_ns - inputs.now_ns - config.pressure_delay_ns) - base
    start = _NS * (observer.inclination_ns - inputs.now_ns - config.inclination_delay_ns) - base
    end = lead - base
    line = gains.observer.line_s
    chamber = observer.chamber_kpa + supplied(observer, period, pressure_at, start - line)
    angle, rate, _ = carried(
        observer, state.theta, period, observer.angle_deg, observer.rate_deg_s, chamber, start - line, end - line
    )
    measurement.angle_deg, measurement.rate_deg_s = angle, rate
    measurement.chamber_kpa = max(observer.chamber_kpa + supplied(observer, period, pressure_at, end), 0.0)
    measurement.disturbance_deg_s2 = observer.disturbance_deg_s2
    measurement.trust = trust(gains.observer, observer)
