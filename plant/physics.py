"""Bringing the physics forward: fixed-step RK4 in pieces that begin and end where an input changes or a sample is taken.

Inputs are constant within a piece; a coil current moves one way within it, so that the valves' play is exact in every stage.
"""

from __future__ import annotations

from math import ceil, exp, inf, log
from typing import Any

from numba import types

from softloop.plant.air import rig_air_slopes, static_air_slopes
from softloop.plant.mechanics import acceleration, advance_memory
from softloop.plant.records import (
    ANGLE,
    CHAMBER,
    CREEP_0,
    N_CREEP,
    PLANT_TYPE,
    RATE,
    STATE_TYPE,
    SUPPLY,
    TUBE,
)
from softloop.plant.spool import first_stop, hold_in_stroke
from softloop.wire.kernel import kernel

_F8 = types.f8
_I8 = types.i8
_NS = 1e-9
_MAX_STOPS_PER_STEP = 4  # both spools, a lift and a fall each
_ROUNDING = 1e-6  # of a step
_SHORTEST_S = 1e-9  # no piece is made shorter than this
_SETTLED_MA = 1e-9  # a coil's transient ends here, before it becomes a denormal number, which is slow


@kernel(_F8(_F8, _F8, _F8))
def play(current_ma: float, held_ma: float, half_width_ma: float) -> float:
    """The play operator: what the spool feels of a current, behind a loop of twice `half_width_ma`."""
    return max(current_ma - half_width_ma, min(current_ma + half_width_ma, held_ma))


@kernel(types.UniTuple(_F8, 2)(PLANT_TYPE, STATE_TYPE))
def play_widths(params: Any, state: Any) -> tuple[float, float]:
    """Half widths of the two valves' loops, mA; a valve that is stuck feels no current any more."""
    charge = inf if state.broken.charge_stuck else params.air.play_charge_ma
    exhaust = inf if state.broken.exhaust_stuck else params.air.play_exhaust_ma
    return charge, exhaust


@kernel(types.void(PLANT_TYPE, STATE_TYPE, _F8, _F8))
def slopes(params: Any, state: Any, charge_ma: float, exhaust_ma: float) -> None:
    """The right-hand side: `state.slope` from `state.stage` and the currents that the spools feel."""
    x, slope = state.stage, state.slope
    angle, mechanics = x[ANGLE], params.mechanics
    slope[ANGLE] = x[RATE]
    slope[RATE] = acceleration(mechanics, state.memory, angle, x[RATE], x[CHAMBER], x[CREEP_0], x[CREEP_0 + 1], x[CREEP_0 + 2])
    if params.rig:
        for i in range(N_CREEP):
            slope[CREEP_0 + i] = (angle - x[CREEP_0 + i]) * mechanics.creep_rate[i]
        rig_air_slopes(params.air, state, charge_ma, exhaust_ma)
    else:
        static_air_slopes(params.air, state, charge_ma, exhaust_ma)


@kernel(types.void(PLANT_TYPE, STATE_TYPE, _F8, _F8))
def _next_stage(params: Any, state: Any, weight_s: float, step_s: float) -> None:
    """Add the slope to the step's result with its weight and go to the stage `step_s` ahead."""
    for i in range(params.n_states):
        state.next[i] += weight_s * state.slope[i]
        state.stage[i] = state.x[i] + step_s * state.slope[i]


@kernel(_F8(_F8))
def _left(transient_ma: float) -> float:
    return transient_ma if abs(transient_ma) > _SETTLED_MA else 0.0


@kernel(types.void(PLANT_TYPE, STATE_TYPE, _F8, _F8))
def _try(params: Any, state: Any, step_s: float, half_decay: float) -> None:
    """One RK4 step into `state.next`; nothing else changes. `half_decay`: what is left of a coil's transient after half of it."""
    decay = half_decay * half_decay
    charge, exhaust = state.command_charge_ma, state.command_exhaust_ma
    charge_off, exhaust_off = state.coil_charge_ma - charge, state.coil_exhaust_ma - exhaust
    width_in, width_out = play_widths(params, state)
    middle_in = play(charge + charge_off * half_decay, state.play_charge_ma, width_in)
    middle_out = play(exhaust + exhaust_off * half_decay, state.play_exhaust_ma, width_out)
    for i in range(params.n_states):
        state.stage[i] = state.x[i]
        state.next[i] = state.x[i]
    slopes(params, state, state.play_charge_ma, state.play_exhaust_ma)
    state.push_before[0], state.push_before[1] = state.push[0], state.push[1]
    _next_stage(params, state, step_s / 6.0, 0.5 * step_s)
    slopes(params, state, middle_in, middle_out)
    _next_stage(params, state, step_s / 3.0, 0.5 * step_s)
    slopes(params, state, middle_in, middle_out)
    state.push_middle[0], state.push_middle[1] = state.push[0], state.push[1]
    _next_stage(params, state, step_s / 3.0, step_s)
    end_in = play(charge + charge_off * decay, state.play_charge_ma, width_in)
    end_out = play(exhaust + exhaust_off * decay, state.play_exhaust_ma, width_out)
    slopes(params, state, end_in, end_out)
    for i in range(params.n_states):
        state.next[i] += step_s / 6.0 * state.slope[i]


@kernel(types.void(PLANT_TYPE, STATE_TYPE, _F8))
def _accept(params: Any, state: Any, half_decay: float) -> None:
    """Make the tried step the state, and bring every memory to it."""
    for i in range(params.n_states):
        state.x[i] = state.next[i]
    decay = half_decay * half_decay
    state.coil_charge_ma = state.command_charge_ma + _left(state.coil_charge_ma - state.command_charge_ma) * decay
    state.coil_exhaust_ma = state.command_exhaust_ma + _left(state.coil_exhaust_ma - state.command_exhaust_ma) * decay
    width_in, width_out = play_widths(params, state)
    state.play_charge_ma = play(state.coil_charge_ma, state.play_charge_ma, width_in)
    state.play_exhaust_ma = play(state.coil_exhaust_ma, state.play_exhaust_ma, width_out)
    if params.mechanics.memory:
        advance_memory(params.mechanics, state.memory, state.x[ANGLE])
    state.steps += 1


@kernel(_F8(_F8, _F8))
def decay_over(step_s: float, lag_s: float) -> float:
    """What is left of a first-order transient after `step_s`."""
    return exp(-step_s / lag_s) if lag_s > 0.0 else 0.0


@kernel(types.void(PLANT_TYPE, STATE_TYPE, _F8, _F8))
def step(params: Any, state: Any, step_s: float, half_decay: float) -> None:
    """One step, divided where a spool reaches a stop, where it stays without a bounce, and where it leaves one."""
    left_s, half = step_s, half_decay
    _try(params, state, left_s, half)
    for _ in range(_MAX_STOPS_PER_STEP if params.rig else 0):
        share, place, stop = first_stop(params.air, state, left_s)
        if share >= 1.0:
            break
        before = decay_over(0.5 * share * left_s, params.air.coil_lag_s)
        _try(params, state, share * left_s, before)
        state.next[place], state.next[place + 1] = stop, 0.0
        _accept(params, state, before)
        left_s -= share * left_s
        half = decay_over(0.5 * left_s, params.air.coil_lag_s)
        _try(params, state, left_s, half)
    _accept(params, state, half)
    if params.rig:
        hold_in_stroke(params.air, state)


@kernel(types.void(PLANT_TYPE, STATE_TYPE))
def settle_inputs(params: Any, state: Any) -> None:
    """After a command: without a lag of the coil the current, and what the spool feels, jump with it."""
    if params.air.coil_lag_s == 0.0:
        state.coil_charge_ma, state.coil_exhaust_ma = state.command_charge_ma, state.command_exhaust_ma
    width_in, width_out = play_widths(params, state)
    state.play_charge_ma = play(state.coil_charge_ma, state.play_charge_ma, width_in)
    state.play_exhaust_ma = play(state.coil_exhaust_ma, state.play_exhaust_ma, width_out)


@kernel(_F8(_F8, _F8, _F8, _F8, _F8))
def _follow(value: float, before: float, after: float, decay: float, lag_steps: float) -> float:
    """A first-order lag over one step in which its input runs straight from `before` to `after`."""
    trail = (after - before) * lag_steps
    return after - trail + (value - before + trail) * decay


@kernel(_F8(PLANT_TYPE, STATE_TYPE))
def block_kpa(params: Any, state: Any) -> float:
    """The pressure at the valve block, where the chamber's sensor sits."""
    return state.x[TUBE] if params.rig else state.x[CHAMBER]


@kernel(_F8(_F8, _F8, _F8, _F8, _F8))
def slip_s(coil_ma: float, command_ma: float, held_ma: float, half_width_ma: float, lag_s: float) -> float:
    """When from now on the coil's transient begins to move the play; inf when it does not, or already does."""
    off, edge = coil_ma - command_ma, held_ma - half_width_ma
    if off < 0.0:
        edge = held_ma + half_width_ma
    if lag_s <= 0.0 or half_width_ma <= 0.0 or off == 0.0:
        return inf
    share = (edge - command_ma) / off
    at_s = -lag_s * log(share) if 0.0 < share < 1.0 else inf
    return at_s if at_s > _SHORTEST_S else inf


@kernel(types.void(PLANT_TYPE, STATE_TYPE, _F8))
def _advance_smooth(params: Any, state: Any, span_s: float) -> None:
    """Equal steps over a piece without a kink of the currents; the sensors' lags follow."""
    count = max(1, ceil(span_s / (_NS * params.step_ns) - _ROUNDING))
    step_s = span_s / count
    half_decay = decay_over(0.5 * step_s, params.air.coil_lag_s)
    pressure_lag, device_lag = params.electrical.pressure_lag_s, state.inclinometer.lag_s
    pressure_decay, device_decay = decay_over(step_s, pressure_lag), decay_over(step_s, device_lag)
    pressure_steps, device_steps = pressure_lag / step_s, device_lag / step_s
    for _ in range(count):
        supply, block, angle, rate = state.x[SUPPLY], block_kpa(params, state), state.x[ANGLE], state.x[RATE]
        step(params, state, step_s, half_decay)
        x, sensor, block_now = state.x, state.inclinometer, block_kpa(params, state)
        state.sensed_supply_kpa = _follow(state.sensed_supply_kpa, supply, x[SUPPLY], pressure_decay, pressure_steps)
        state.sensed_chamber_kpa = _follow(state.sensed_chamber_kpa, block, block_now, pressure_decay, pressure_steps)
        sensor.angle_deg = _follow(sensor.angle_deg, angle, x[ANGLE], device_decay, device_steps)
        sensor.rate_deg_s = _follow(sensor.rate_deg_s, rate, x[RATE], device_decay, device_steps)


@kernel(types.void(PLANT_TYPE, STATE_TYPE, _I8))
def advance(params: Any, state: Any, to_ns: int) -> None:
    """Bring physics and sensor lags to `to_ns`, in steps of at most `params.step_ns`, divided also where a play slips."""
    if to_ns <= state.t_ns:
        return
    left_s, air = _NS * (to_ns - state.t_ns), params.air
    width_in, width_out = play_widths(params, state)
    for _ in range(2 if params.rig else 0):
        slip_in = slip_s(state.coil_charge_ma, state.command_charge_ma, state.play_charge_ma, width_in, air.coil_lag_s)
        slip_out = slip_s(state.coil_exhaust_ma, state.command_exhaust_ma, state.play_exhaust_ma, width_out, air.coil_lag_s)
        piece_s = min(slip_in, slip_out)
        if piece_s < left_s - _SHORTEST_S:
            _advance_smooth(params, state, piece_s)
            left_s -= piece_s
    _advance_smooth(params, state, left_s)
    state.t_ns = to_ns
