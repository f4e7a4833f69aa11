"""Bringing the physics forward: fixed-step RK4 in pieces that begin and end where an input changes or a sample is taken.

Inputs are constant within a piece; a coil current moves one way within it, so that the valves' play is exact in every stage.
"""

from __future__ import annotations

from math import exp
from typing import Any

from numba import types

from softloop.plant.air import rig_air_slopes, static_air_slopes, stop_spool
from softloop.plant.mechanics import acceleration, advance_memory
from softloop.plant.records import (
    ANGLE,
    AREA_IN,
    AREA_OUT,
    CHAMBER,
    CREEP_0,
    N_CREEP,
    PLANT_TYPE,
    RATE,
    STATE_TYPE,
    SUPPLY,
    TUBE,
)
from softloop.wire.kernel import kernel

_F8 = types.f8
_I8 = types.i8
_NS = 1e-9
_SETTLED_MA = 1e-9  # a coil's transient ends here, before it becomes a denormal number, which is slow


@kernel(_F8(_F8, _F8, _F8))
def play(current_ma: float, held_ma: float, half_width_ma: float) -> float:
    """The play operator: what the spool feels of a current, behind a loop of twice `half_width_ma`."""
    return max(current_ma - half_width_ma, min(current_ma + half_width_ma, held_ma))


@kernel(types.void(PLANT_TYPE, STATE_TYPE, _F8, _F8))
def slopes(params: Any, state: Any, charge_ma: float, exhaust_ma: float) -> None:
    """The right-hand side: `state.slope` from `state.stage` and the currents that the spools feel."""
    x, slope = state.stage, state.slope
    angle, mechanics = x[ANGLE], params.mechanics
    slope[ANGLE] = x[RATE]
    slope[RATE] = acceleration(
        mechanics, state.memory, angle, x[RATE], x[CHAMBER], x[CREEP_0], x[CREEP_0 + 1], x[CREEP_0 + 2]
    )
    if params.rig:
        for i in range(N_CREEP):
            slope[CREEP_0 + i] = (angle - x[CREEP_0 + i]) * mechanics.creep_rate[i]
        rig_air_slopes(params.air, state, charge_ma, exhaust_ma)
    else:
        static_air_slopes(params.air, state, charge_ma, exhaust_ma)


@kernel(types.void(PLANT_TYPE, STATE_TYPE, _F8, _F8))
def _next_stage(params: Any, state: Any, weight: float, step_s: float) -> None:
    """Add the slope to the step's sum with `weight` (in sixths) and go to the stage `step_s` ahead."""
    for i in range(params.n_states):
        state.sum[i] += weight * state.slope[i]
        state.stage[i] = state.x[i] + step_s * state.slope[i]


@kernel(_F8(_F8))
def _left(transient_ma: float) -> float:
    return transient_ma if abs(transient_ma) > _SETTLED_MA else 0.0


@kernel(types.void(PLANT_TYPE, STATE_TYPE, _F8, _F8))
def step(params: Any, state: Any, step_s: float, half_decay: float) -> None:
    """One RK4 step. `half_decay` is what is left of a coil's transient after half of it."""
    air = params.air
    charge, exhaust = state.command_charge_ma, state.command_exhaust_ma
    charge_off, exhaust_off = _left(state.coil_charge_ma - charge), _left(state.coil_exhaust_ma - exhaust)
    middle_in = play(charge + charge_off * half_decay, state.play_charge_ma, air.play_charge_ma)
    middle_out = play(exhaust + exhaust_off * half_decay, state.play_exhaust_ma, air.play_exhaust_ma)
    end_in = play(charge + charge_off * half_decay * half_decay, state.play_charge_ma, air.play_charge_ma)
    end_out = play(exhaust + exhaust_off * half_decay * half_decay, state.play_exhaust_ma, air.play_exhaust_ma)
    for i in range(params.n_states):
        state.stage[i] = state.x[i]
        state.sum[i] = 0.0
    slopes(params, state, state.play_charge_ma, state.play_exhaust_ma)
    _next_stage(params, state, 1.0, 0.5 * step_s)
    slopes(params, state, middle_in, middle_out)
    _next_stage(params, state, 2.0, 0.5 * step_s)
    slopes(params, state, middle_in, middle_out)
    _next_stage(params, state, 2.0, step_s)
    slopes(params, state, end_in, end_out)
    for i in range(params.n_states):
        state.x[i] += step_s / 6.0 * (state.sum[i] + state.slope[i])
    state.coil_charge_ma = charge + charge_off * half_decay * half_decay
    state.coil_exhaust_ma = exhaust + exhaust_off * half_decay * half_decay
    state.play_charge_ma, state.play_exhaust_ma = end_in, end_out
    if params.rig:
        stop_spool(air.charge, state, AREA_IN)
        stop_spool(air.exhaust, state, AREA_OUT)
    if params.mechanics.memory:
        advance_memory(params.mechanics, state.memory, state.x[ANGLE])
    state.steps += 1


@kernel(types.void(PLANT_TYPE, STATE_TYPE))
def settle_inputs(params: Any, state: Any) -> None:
    """After a command: without a lag of the coil the current, and what the spool feels, jump with it."""
    if params.air.coil_lag_s == 0.0:
        state.coil_charge_ma, state.coil_exhaust_ma = state.command_charge_ma, state.command_exhaust_ma
    state.play_charge_ma = play(state.coil_charge_ma, state.play_charge_ma, params.air.play_charge_ma)
    state.play_exhaust_ma = play(state.coil_exhaust_ma, state.play_exhaust_ma, params.air.play_exhaust_ma)


@kernel(_F8(_F8, _F8))
def _decay(step_s: float, lag_s: float) -> float:
    """What is left of a first-order transient after `step_s`."""
    return exp(-step_s / lag_s) if lag_s > 0.0 else 0.0


@kernel(_F8(_F8, _F8, _F8, _F8, _F8))
def _follow(value: float, before: float, after: float, decay: float, lag_steps: float) -> float:
    """A first-order lag over one step in which its input runs straight from `before` to `after`."""
    trail = (after - before) * lag_steps
    return after - trail + (value - before + trail) * decay


@kernel(_F8(PLANT_TYPE, STATE_TYPE))
def block_kpa(params: Any, state: Any) -> float:
    """The pressure at the valve block, where the chamber's sensor sits."""
    return state.x[TUBE] if params.rig else state.x[CHAMBER]


@kernel(types.void(PLANT_TYPE, STATE_TYPE, _I8))
def advance(params: Any, state: Any, to_ns: int) -> None:
    """Bring the physics and the sensors' lags to `to_ns` in equal steps of at most `params.step_ns`."""
    span_ns = to_ns - state.t_ns
    if span_ns <= 0:
        return
    count = (span_ns + params.step_ns - 1) // params.step_ns
    step_s = _NS * span_ns / count
    half_decay = _decay(0.5 * step_s, params.air.coil_lag_s)
    pressure_lag, device_lag = params.electrical.pressure_lag_s, state.inclinometer.lag_s
    pressure_decay, device_decay = _decay(step_s, pressure_lag), _decay(step_s, device_lag)
    for _ in range(count):
        supply, block, angle, rate = state.x[SUPPLY], block_kpa(params, state), state.x[ANGLE], state.x[RATE]
        step(params, state, step_s, half_decay)
        x, sensor, n_lag = state.x, state.inclinometer, pressure_lag / step_s
        state.sensed_supply_kpa = _follow(state.sensed_supply_kpa, supply, x[SUPPLY], pressure_decay, n_lag)
        state.sensed_chamber_kpa = _follow(state.sensed_chamber_kpa, block, block_kpa(params, state), pressure_decay, n_lag)
        sensor.angle_deg = _follow(sensor.angle_deg, angle, x[ANGLE], device_decay, device_lag / step_s)
        sensor.rate_deg_s = _follow(sensor.rate_deg_s, rate, x[RATE], device_decay, device_lag / step_s)
    state.t_ns = to_ns
