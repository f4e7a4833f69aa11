"""The controller's state after a tick, out of that tick's record: what `record_thoughts` wrote, read back.

The record holds all of the state that a later tick can see: `state.arc` is filled anew in each tick before it is read, and
the coefficients of an approach follow from where it started.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from softloop.controller.records import (
    CONFIG_TYPE,
    CYCLE_TYPE,
    EST_FLOWS,
    EST_INCLINATION_NS,
    EST_PRESSURE_NS,
    IN_APPROACH_START,
    IN_CHARGE_BEFORE_MA,
    IN_EXHAUST_BEFORE_MA,
    IN_INCLINATION_RATE_HZ,
    IN_INTEGRAL_KPA,
    IN_MODE_TICKS,
    IN_PRESSURE_RATE_HZ,
    N_FLOWS,
    OBSERVER_TYPE,
    PHASE_APPROACH,
    PHASE_DONE,
    PHASE_TRACK,
    STATE_TYPE,
)
from softloop.controller.tick import SCRATCH_TYPE, plan_approach
from softloop.wire.kernel import array_of, kernel

_F8 = types.f8


@kernel(types.void(CONFIG_TYPE, array_of(_F8), array_of(_F8, 2), CYCLE_TYPE, STATE_TYPE, SCRATCH_TYPE))
def recall_course(config: Any, knots: np.ndarray, table: np.ndarray, cycle: Any, state: Any, scratch: Any) -> None:
    """Set in `state` what belongs to the course of the run and to no law: counts, phase, its start, the approach."""
    state.seq, state.skipped_total, state.last_ns = cycle.seq, cycle.skipped_total, cycle.stamp_ns
    state.pressure_seq, state.inclination_seq = cycle.pressure_seq, cycle.inclination_seq
    state.pressure_rate_hz = cycle.internal[IN_PRESSURE_RATE_HZ]
    state.inclination_rate_hz = cycle.internal[IN_INCLINATION_RATE_HZ]
    state.phase = cycle.phase
    on_plan = cycle.phase == PHASE_TRACK or cycle.phase == PHASE_DONE
    state.phase_start_ns = cycle.stamp_ns - cycle.trajectory_ns - (0 if on_plan else config.approach_ns)
    for i in range(1, state.approach.size):  # read in no phase but the approach
        state.approach[i] = 0.0
    state.approach[0] = cycle.internal[IN_APPROACH_START]
    if cycle.phase == PHASE_APPROACH:
        plan_approach(config, knots, table, state.approach[0], state, scratch)


@kernel(types.void(CYCLE_TYPE, OBSERVER_TYPE))
def recall_observer(cycle: Any, observer: Any) -> None:
    """Set `observer` from what `record_observer` wrote. Ages in ns are exact in a float64 up to 100 days."""
    e = cycle.estimator
    observer.angle_deg, observer.rate_deg_s, observer.disturbance_deg_s2 = e[0], e[1], e[2]
    observer.gyro_bias_deg_s, observer.chamber_kpa, observer.charge_offset_ma = e[3], e[4], e[5]
    observer.exhaust_offset_ma, observer.hold_kpa_s, observer.charge_play_ma = e[6], e[7], e[8]
    observer.exhaust_play_ma, observer.innovation_deg_s, observer.innovation_power = e[9], e[10], e[11]
    observer.innovation_pair = e[12]
    observer.inclination_ns = cycle.stamp_ns - int(e[EST_INCLINATION_NS])
    observer.pressure_ns = cycle.stamp_ns - int(e[EST_PRESSURE_NS])
    for j in range(N_FLOWS):
        observer.flow_kpa_s[j] = e[EST_FLOWS + j]


@kernel(types.void(CONFIG_TYPE, array_of(_F8), array_of(_F8, 2), CYCLE_TYPE, STATE_TYPE, SCRATCH_TYPE))
def recall(config: Any, knots: np.ndarray, table: np.ndarray, cycle: Any, state: Any, scratch: Any) -> None:
    """Set `state` to what it was after the tick that left `cycle`, as far as any later tick can tell."""
    recall_course(config, knots, table, cycle, state, scratch)
    recall_observer(cycle, state.observer)
    for i in range(state.theta.size):
        state.theta[i] = cycle.theta[i]
    state.charge_ma, state.exhaust_ma = cycle.charge_current_ma, cycle.exhaust_current_ma
    state.charge_before_ma = cycle.internal[IN_CHARGE_BEFORE_MA]
    state.exhaust_before_ma = cycle.internal[IN_EXHAUST_BEFORE_MA]
    state.pid.integral_kpa = cycle.internal[IN_INTEGRAL_KPA]
    state.mode_ticks = int(cycle.internal[IN_MODE_TICKS])
    state.mode, state.saturated = cycle.mode, cycle.saturated
