"""One tick of the controller, whole: inputs in, cycle record out. Pure in its arguments, so a log replays to the byte."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from softloop.controller.actuation import actuate
from softloop.controller.estimator import measure, read_samples
from softloop.controller.laws.arc import STEP1_TYPE, arc_step
from softloop.controller.laws.arc_eso import arc_eso_step
from softloop.controller.laws.pid import pid_step
from softloop.controller.laws.pressure import pressure_step
from softloop.controller.laws.smc import smc_step
from softloop.controller.laws.valve_test import valve_test_step
from softloop.controller.observer import begin_observer, observe
from softloop.controller.records import (
    CONFIG_TYPE,
    CYCLE_TYPE,
    DEMAND,
    DEMAND_TYPE,
    EST_FLOWS,
    EST_INCLINATION_NS,
    EST_PRESSURE_NS,
    GAINS_TYPE,
    GATE_ARMED,
    IN_APPROACH_START,
    IN_CHAMBER_KPA,
    IN_CHARGE_BEFORE_MA,
    IN_EXHAUST_BEFORE_MA,
    IN_INCLINATION_RATE_HZ,
    IN_INTEGRAL_KPA,
    IN_MODE_TICKS,
    IN_PERIOD_S,
    IN_PRESSURE_RATE_HZ,
    IN_SUPPLY_KPA,
    INPUTS_TYPE,
    LAW_ARC,
    LAW_ARC_ESO,
    LAW_PID,
    LAW_PID_ESO,
    LAW_PRESSURE,
    LAW_PRESSURE_ESO,
    LAW_SMC,
    LAW_VALVE_TEST,
    MEASUREMENT,
    MEASUREMENT_TYPE,
    MODE_HOLD,
    N_FLOWS,
    OBSERVER_TYPE,
    PHASE_APPROACH,
    PHASE_DONE,
    PHASE_TRACK,
    PHASE_WAIT,
    REFERENCE,
    REFERENCE_TYPE,
    SAMPLE_OK,
    STATE_TYPE,
)
from softloop.controller.references import SINES, polynomial_at, reference_at, sines_at
from softloop.controller.valve_drive import drive_valves, note_flow
from softloop.dynamics.parameters import MODEL_TYPE, THETA_TYPE
from softloop.wire.kernel import array_of, kernel, record_dtype, record_type

_F8 = types.f8

SCRATCH = record_dtype([("measurement", MEASUREMENT), ("reference", REFERENCE), ("demand", DEMAND), ("end", REFERENCE)])
SCRATCH_TYPE = record_type(SCRATCH)


@kernel(types.b1(CONFIG_TYPE, INPUTS_TYPE))
def inputs_valid(config: Any, inputs: Any) -> bool:
    """Every input has come, is fresh, says that it is good, and is a number."""
    if inputs.pressure.seq == 0 or inputs.inclination.seq == 0 or inputs.valves.seq == 0:
        return False
    if inputs.now_ns - inputs.pressure.stamp_ns > config.pressure_budget_ns:
        return False
    if inputs.now_ns - inputs.inclination.stamp_ns > config.inclination_budget_ns:
        return False
    numbers = inputs.pressure.supply_pressure_kpa + inputs.pressure.chamber_pressure_kpa
    numbers += inputs.inclination.angle_deg + inputs.inclination.rate_deg_s
    return bool(inputs.pressure.status == SAMPLE_OK and np.isfinite(numbers))


RATE_WINDOW_S = 0.5  # long beside the jitter of a free-running sensor, short beside the parameters' own pace


@kernel(_F8(_F8, types.b1, _F8))
def rate_after(rate_hz: float, fresh: bool, elapsed_s: float) -> float:
    """A running mean over `RATE_WINDOW_S` of how often a tick finds a new sample, 1/s, after one more tick."""
    now_hz = 1.0 / elapsed_s if fresh else 0.0
    return float(rate_hz + (now_hz - rate_hz) * elapsed_s / (RATE_WINDOW_S + elapsed_s))


@kernel(types.b1(CONFIG_TYPE, INPUTS_TYPE, STATE_TYPE))
def inputs_often_enough(config: Any, inputs: Any, state: Any) -> bool:
    """Count the new samples of this tick; whether both sensors still bring them at the declared rate."""
    elapsed_ns = inputs.now_ns - state.last_ns
    elapsed_s = 1e-9 * (elapsed_ns if state.last_ns != 0 and elapsed_ns > 0 else config.period_ns)
    state.pressure_rate_hz = rate_after(state.pressure_rate_hz, inputs.pressure.seq != state.pressure_seq, elapsed_s)
    state.inclination_rate_hz = rate_after(state.inclination_rate_hz, inputs.inclination.seq != state.inclination_seq, elapsed_s)
    state.pressure_seq, state.inclination_seq = inputs.pressure.seq, inputs.inclination.seq
    return bool(min(state.pressure_rate_hz, state.inclination_rate_hz) >= config.input_rate_min_hz)


@kernel(types.void(_F8, REFERENCE_TYPE, _F8, THETA_TYPE))
def move_between(start: float, end: Any, seconds: float, coefficients: np.ndarray) -> None:
    """The polynomial of degree seven from rest at `start` to `end` with its derivatives; see `references.smooth_move`.

    In time over `seconds` the four open coefficients follow from the four end conditions in closed form.
    """
    gap = end.value - start
    v, a, j = end.rate * seconds, end.acceleration * seconds**2, end.jerk * seconds**3
    coefficients[0] = start
    coefficients[1], coefficients[2], coefficients[3] = 0.0, 0.0, 0.0
    coefficients[4] = (35.0 * gap - 15.0 * v + 2.5 * a - j / 6.0) / seconds**4
    coefficients[5] = (-84.0 * gap + 39.0 * v - 7.0 * a + 0.5 * j) / seconds**5
    coefficients[6] = (70.0 * gap - 34.0 * v + 6.5 * a - 0.5 * j) / seconds**6
    coefficients[7] = (-20.0 * gap + 10.0 * v - 2.0 * a + j / 6.0) / seconds**7


@kernel(types.b1(CONFIG_TYPE))
def fades_in(config: Any) -> bool:
    """Whether a multi-sine, which goes on before its start too, is faded in from where the rig is.

    Its derivatives are large: a polynomial of some seconds that ends with them swings far out of any valve's range.
    """
    return bool(config.plan_kind == SINES and (config.law == LAW_PRESSURE or config.law == LAW_PRESSURE_ESO))


@kernel(types.void(CONFIG_TYPE, array_of(_F8), array_of(_F8, 2), _F8, STATE_TYPE, SCRATCH_TYPE))
def plan_approach(config: Any, knots: np.ndarray, table: np.ndarray, start: float, state: Any, scratch: Any) -> None:
    """The coefficients of the move from `start`: to the trajectory's first point, or, to fade in, by 1 and at rest."""
    reference_at(config.plan_kind, knots, table, 0.0, scratch.end)
    if fades_in(config):
        scratch.end.value = start + 1.0
        scratch.end.rate, scratch.end.acceleration, scratch.end.jerk = 0.0, 0.0, 0.0
    move_between(start, scratch.end, 1e-9 * config.approach_ns, state.approach)


@kernel(types.void(CONFIG_TYPE, array_of(_F8, 2), STATE_TYPE, _F8, REFERENCE_TYPE))
def faded(config: Any, table: np.ndarray, state: Any, time_s: float, reference: Any) -> None:
    """The multi-sine's share w grows from 0 to 1: start + w (sines - start) and its derivatives, between both at any time."""
    start = state.approach[0]
    sines_at(table, time_s - 1e-9 * config.approach_ns, reference)
    p, p1, p2, p3 = reference.value - start, reference.rate, reference.acceleration, reference.jerk
    polynomial_at(state.approach, time_s, reference)
    w, w1, w2, w3 = reference.value - start, reference.rate, reference.acceleration, reference.jerk
    reference.value = start + w * p
    reference.rate = w1 * p + w * p1
    reference.acceleration = w2 * p + 2.0 * w1 * p1 + w * p2
    reference.jerk = w3 * p + 3.0 * w2 * p1 + 3.0 * w1 * p2 + w * p3


@kernel(types.void(CONFIG_TYPE, MODEL_TYPE, INPUTS_TYPE, array_of(_F8), array_of(_F8, 2), STATE_TYPE, SCRATCH_TYPE))
def begin_approach(config: Any, model: Any, inputs: Any, knots: np.ndarray, table: np.ndarray, state: Any, scratch: Any) -> None:
    """Start the smooth move from where the rig is to the trajectory's first point (value and three derivatives).

    Nothing of what was learned before is kept: what led to a fault may have taught it.
    """
    start = inputs.inclination.angle_deg
    if config.law in (LAW_PRESSURE, LAW_PRESSURE_ESO):
        start = inputs.pressure.chamber_pressure_kpa
    elif config.law == LAW_VALVE_TEST:  # a current
        start = 0.0
    plan_approach(config, knots, table, start, state, scratch)
    state.phase = PHASE_APPROACH
    state.phase_start_ns = inputs.now_ns
    state.pid.integral_kpa = inputs.pressure.chamber_pressure_kpa
    state.mode = MODE_HOLD
    state.mode_ticks = 0
    for i in range(state.theta.size):
        state.theta[i] = model.theta[i]
    begin_observer(inputs, state.observer)


@kernel(types.void(CONFIG_TYPE, MODEL_TYPE, INPUTS_TYPE, array_of(_F8), array_of(_F8, 2), STATE_TYPE, SCRATCH_TYPE))
def follow_phase(config: Any, model: Any, inputs: Any, knots: np.ndarray, table: np.ndarray, state: Any, scratch: Any) -> None:
    """WAIT -> APPROACH once armed with valid inputs -> TRACK -> DONE; back to WAIT whenever the gate is not armed.

    A rig that was armed in mid-vent still falls: the approach, which begins at rest, waits until the rig nearly does.
    """
    armed = inputs.valves.gate == GATE_ARMED
    if not armed and state.phase != PHASE_DONE:
        state.phase = PHASE_WAIT
        for i in range(state.approach.size):  # an approach that was broken off must not go on in the log beyond its end
            state.approach[i] = 0.0
    resting = abs(inputs.inclination.rate_deg_s) <= config.rest_deg_s
    if state.phase == PHASE_WAIT and armed and resting and inputs_valid(config, inputs):
        begin_approach(config, model, inputs, knots, table, state, scratch)
    if state.phase == PHASE_APPROACH and inputs.now_ns - state.phase_start_ns >= config.approach_ns:
        state.phase = PHASE_TRACK
        state.phase_start_ns += config.approach_ns
    if state.phase == PHASE_TRACK and inputs.now_ns - state.phase_start_ns >= config.plan_ns:
        state.phase = PHASE_DONE


@kernel(types.void(CONFIG_TYPE, array_of(_F8), array_of(_F8, 2), STATE_TYPE, types.i8, REFERENCE_TYPE))
def reference_now(config: Any, knots: np.ndarray, table: np.ndarray, state: Any, now_ns: int, reference: Any) -> None:
    """The point of the trajectory, or of the move towards it, that stands at `now_ns`."""
    if state.phase == PHASE_TRACK or state.phase == PHASE_DONE:
        reference_at(config.plan_kind, knots, table, 1e-9 * (now_ns - state.phase_start_ns), reference)
    elif state.phase == PHASE_APPROACH and now_ns - state.phase_start_ns >= config.approach_ns:
        past_ns = now_ns - state.phase_start_ns - config.approach_ns
        reference_at(config.plan_kind, knots, table, 1e-9 * past_ns, reference)
    elif fades_in(config):
        faded(config, table, state, 1e-9 * (now_ns - state.phase_start_ns), reference)
    else:
        polynomial_at(state.approach, 1e-9 * (now_ns - state.phase_start_ns), reference)


@kernel(types.void(types.i8, MODEL_TYPE, MEASUREMENT_TYPE, REFERENCE_TYPE, GAINS_TYPE, STATE_TYPE, STEP1_TYPE, DEMAND_TYPE))
def law_step(law: int, model: Any, measurement: Any, reference: Any, gains: Any, state: Any, first: Any, demand: Any) -> None:
    """The law of this run; a new law is one more line here and one file beside the others."""
    if law in (LAW_PID, LAW_PID_ESO):
        pid_step(measurement, reference, gains, state, demand)
    elif law == LAW_ARC:
        arc_step(model, measurement, reference, gains, state, first, demand)
    elif law == LAW_SMC:
        smc_step(model, measurement, reference, gains, state, first, demand)
    elif law == LAW_ARC_ESO:
        arc_eso_step(model, measurement, reference, gains, state, first, demand)
    elif law in (LAW_PRESSURE, LAW_PRESSURE_ESO):
        pressure_step(measurement, reference, gains, state, demand)
    elif law == LAW_VALVE_TEST:
        valve_test_step(measurement, reference, gains, state, demand)


@kernel(types.void(STATE_TYPE, DEMAND_TYPE))
def stand_still(state: Any, demand: Any) -> None:
    """Ask for nothing: both currents zero, which the gate passes on only as its own safe output."""
    state.charge_before_ma, state.exhaust_before_ma = state.charge_ma, state.exhaust_ma
    state.charge_ma, state.exhaust_ma = 0.0, 0.0
    state.mode, state.saturated = MODE_HOLD, 0
    demand.flow_kpa_s, demand.desired_pressure_kpa = 0.0, 0.0
    demand.error, demand.s1, demand.s2, demand.mode = 0.0, 0.0, 0.0, MODE_HOLD


@kernel(types.void(INPUTS_TYPE, STATE_TYPE, CYCLE_TYPE))
def record_inputs(inputs: Any, state: Any, cycle: Any) -> None:
    """What this tick saw, into the cycle record."""
    cycle.seq, cycle.stamp_ns, cycle.tick = state.seq, inputs.now_ns, inputs.tick
    cycle.skipped, cycle.skipped_total = inputs.skipped, state.skipped_total
    cycle.pressure_seq, cycle.pressure_stamp_ns = inputs.pressure.seq, inputs.pressure.stamp_ns
    cycle.pressure_age_ns = inputs.now_ns - inputs.pressure.stamp_ns
    cycle.inclination_seq, cycle.inclination_stamp_ns = inputs.inclination.seq, inputs.inclination.stamp_ns
    cycle.inclination_age_ns = inputs.now_ns - inputs.inclination.stamp_ns
    cycle.valve_seq, cycle.valve_stamp_ns = inputs.valves.seq, inputs.valves.stamp_ns
    cycle.supply_pressure_kpa = inputs.pressure.supply_pressure_kpa
    cycle.chamber_pressure_kpa = inputs.pressure.chamber_pressure_kpa
    cycle.angle_deg, cycle.rate_deg_s = inputs.inclination.angle_deg, inputs.inclination.rate_deg_s
    cycle.charge_applied_ma, cycle.exhaust_applied_ma = inputs.valves.charge_current_ma, inputs.valves.exhaust_current_ma
    cycle.gate = inputs.valves.gate


@kernel(types.void(OBSERVER_TYPE, CYCLE_TYPE))
def record_observer(observer: Any, cycle: Any) -> None:
    """All that the observer knows, into the cycle record; `recall` reads it back."""
    e = cycle.estimator
    e[0], e[1], e[2] = observer.angle_deg, observer.rate_deg_s, observer.disturbance_deg_s2
    e[3], e[4], e[5] = observer.gyro_bias_deg_s, observer.chamber_kpa, observer.charge_offset_ma
    e[6], e[7], e[8] = observer.exhaust_offset_ma, observer.hold_kpa_s, observer.charge_play_ma
    e[9], e[10], e[11] = observer.exhaust_play_ma, observer.innovation_deg_s, observer.innovation_power
    e[12] = observer.innovation_pair
    e[EST_INCLINATION_NS] = cycle.stamp_ns - observer.inclination_ns
    e[EST_PRESSURE_NS] = cycle.stamp_ns - observer.pressure_ns
    for j in range(N_FLOWS):
        e[EST_FLOWS + j] = observer.flow_kpa_s[j]


@kernel(types.void(CONFIG_TYPE, MEASUREMENT_TYPE, REFERENCE_TYPE, DEMAND_TYPE, STATE_TYPE, types.b1, CYCLE_TYPE))
def record_thoughts(config: Any, measurement: Any, reference: Any, demand: Any, state: Any, valid: bool, cycle: Any) -> None:
    """What this tick made of it, into the cycle record."""
    on_plan = state.phase == PHASE_TRACK or state.phase == PHASE_DONE
    since_ns = cycle.stamp_ns - state.phase_start_ns if state.phase != PHASE_WAIT else 0
    cycle.trajectory_ns = since_ns - (0 if on_plan else config.approach_ns)
    cycle.reference_deg, cycle.reference_rate_deg_s = reference.value, reference.rate
    cycle.reference_acceleration_deg_s2, cycle.reference_jerk_deg_s3 = reference.acceleration, reference.jerk
    # A pressure stands in desired_pressure_kpa, a current in the command.
    if config.law in (LAW_PRESSURE, LAW_PRESSURE_ESO, LAW_VALVE_TEST):
        cycle.reference_deg, cycle.reference_rate_deg_s = np.nan, np.nan
        cycle.reference_acceleration_deg_s2, cycle.reference_jerk_deg_s3 = np.nan, np.nan
    cycle.angle_estimate_deg, cycle.rate_estimate_deg_s = measurement.angle_deg, measurement.rate_deg_s
    cycle.disturbance_deg_s2 = measurement.disturbance_deg_s2
    cycle.error_deg, cycle.s1_deg_s, cycle.s2_kpa = demand.error, demand.s1, demand.s2
    cycle.desired_pressure_kpa, cycle.demanded_flow_kpa_s = demand.desired_pressure_kpa, demand.flow_kpa_s
    cycle.charge_current_ma, cycle.exhaust_current_ma = state.charge_ma, state.exhaust_ma
    for i in range(state.theta.size):
        cycle.theta[i] = state.theta[i]
    cycle.internal[IN_CHAMBER_KPA], cycle.internal[IN_SUPPLY_KPA] = measurement.chamber_kpa, measurement.supply_kpa
    cycle.internal[IN_PERIOD_S] = measurement.period_s
    cycle.internal[IN_INTEGRAL_KPA], cycle.internal[IN_MODE_TICKS] = state.pid.integral_kpa, state.mode_ticks
    cycle.internal[IN_APPROACH_START] = state.approach[0]
    cycle.internal[IN_PRESSURE_RATE_HZ] = state.pressure_rate_hz
    cycle.internal[IN_INCLINATION_RATE_HZ] = state.inclination_rate_hz
    cycle.internal[IN_CHARGE_BEFORE_MA], cycle.internal[IN_EXHAUST_BEFORE_MA] = state.charge_before_ma, state.exhaust_before_ma
    record_observer(state.observer, cycle)
    cycle.observing, cycle.trusted = config.observe, measurement.trust >= 1.0
    cycle.phase, cycle.mode = state.phase, state.mode
    cycle.inputs_valid, cycle.saturated, cycle.adapting = valid, state.saturated, measurement.adapt


@kernel(
    types.void(
        CONFIG_TYPE, MODEL_TYPE, GAINS_TYPE, array_of(_F8), array_of(_F8, 2), INPUTS_TYPE, STATE_TYPE, SCRATCH_TYPE, STEP1_TYPE,
        CYCLE_TYPE,
    )
)  # fmt: skip
def controller_tick(
    config: Any, model: Any, gains: Any, knots: np.ndarray, table: np.ndarray, inputs: Any, state: Any, scratch: Any,
    first: Any, cycle: Any,
) -> None:  # fmt: skip
    """Read `inputs`, move `state`, write the whole of `cycle` but the instants only the process knows.

    Args:
        config: `CONFIG` record.
        model: `MODEL` record with nominal parameters and bounds.
        gains: `GAINS` record.
        knots, table: the trajectory, see `references`.
        inputs: `INPUTS` record.
        state: `CONTROLLER_STATE` record; `state.theta` must hold the parameters to start from.
        scratch, first: records of `SCRATCH` and `STEP1` to work in.
        cycle: `CycleRecord` to fill.
    """
    measurement, reference, demand = scratch.measurement, scratch.reference, scratch.demand
    valid = inputs_valid(config, inputs)
    often_enough = inputs_often_enough(config, inputs, state)
    follow_phase(config, model, inputs, knots, table, state, scratch)
    active = state.phase == PHASE_APPROACH or state.phase == PHASE_TRACK
    if config.observe and active:
        read_samples(config, inputs, state, measurement)
        observe(config, model, gains, inputs, state, measurement)
    else:
        measure(config, model, inputs, state, measurement)
    measurement.adapt = valid and often_enough and state.saturated == 0 and state.phase != PHASE_WAIT
    acts_ns = inputs.now_ns + (config.actuation_delay_ns if config.predict else 0)
    reference_now(config, knots, table, state, acts_ns, reference)
    if active:
        law_step(config.law, model, measurement, reference, gains, state, first, demand)
    if active and config.observe:
        drive_valves(gains, model, measurement, demand, state)
        note_flow(gains, model, measurement, demand, state, inputs.skipped + 1)
    elif active and config.law != LAW_VALVE_TEST:
        actuate(gains.actuation, model, measurement, demand, state)
    elif not active:
        stand_still(state, demand)
    state.last_ns = inputs.now_ns
    state.seq += 1
    state.skipped_total += inputs.skipped
    record_inputs(inputs, state, cycle)
    reference_now(config, knots, table, state, inputs.now_ns, scratch.end)  # what is logged stands at the tick, not ahead of it
    record_thoughts(config, measurement, scratch.end, demand, state, valid, cycle)


@kernel(
    types.void(
        array_of(CONFIG_TYPE), array_of(MODEL_TYPE), array_of(GAINS_TYPE), array_of(_F8), array_of(_F8, 2), array_of(INPUTS_TYPE),
        array_of(STATE_TYPE), array_of(SCRATCH_TYPE), array_of(STEP1_TYPE), array_of(CYCLE_TYPE),
    )
)  # fmt: skip
def controller_tick_of_arrays(
    config: np.ndarray, model: np.ndarray, gains: np.ndarray, knots: np.ndarray, table: np.ndarray, inputs: np.ndarray,
    state: np.ndarray, scratch: np.ndarray, first: np.ndarray, cycle: np.ndarray,
) -> None:  # fmt: skip
    """`controller_tick` on arrays of one record each: from Python a call with arrays costs a third of one with records."""
    controller_tick(config[0], model[0], gains[0], knots, table, inputs[0], state[0], scratch[0], first[0], cycle[0])
