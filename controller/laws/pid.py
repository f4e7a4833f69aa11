"""C1: PID with velocity and acceleration feedforward, over a proportional pressure loop.

The paper names it and gives no formula. Ours: the PID asks for a chamber pressure, and the pressure error, times a gain, for
a flow; the valves' model turns flow into current, as it does for every law here, so that laws differ in nothing else.

The equipped PID (`pid_eso`) is this law on the observer's state, rate and prediction included, with its disturbance
compensated: the pressure it asks for is less by sigma / b0. What separates it from `arc_eso` is then the law alone.
"""

from __future__ import annotations

from typing import Any

from numba import types

from softloop.controller.actuation import choose_mode
from softloop.controller.records import DEMAND_TYPE, GAINS_TYPE, MEASUREMENT_TYPE, REFERENCE_TYPE, STATE_TYPE
from softloop.dynamics.parameters import B0
from softloop.wire.kernel import kernel


@kernel(types.void(MEASUREMENT_TYPE, REFERENCE_TYPE, GAINS_TYPE, STATE_TYPE, DEMAND_TYPE))
def pid_step(measurement: Any, reference: Any, gains: Any, state: Any, demand: Any) -> None:
    """One step of C1, or of the equipped PID; fills `demand`, advances the integral unless the valves are saturated."""
    g, memory = gains.pid, state.pid
    error = measurement.angle_deg - reference.value
    error_rate = measurement.rate_deg_s - reference.rate
    if measurement.adapt:
        grown = memory.integral_kpa - g.ki * error * measurement.period_s
        memory.integral_kpa = min(max(grown, -g.integral_max_kpa), g.integral_max_kpa)
    forward = g.kv * reference.rate + g.ka * reference.acceleration
    desired = forward - g.kp * error - g.kd * error_rate + memory.integral_kpa
    desired -= measurement.disturbance_deg_s2 / state.theta[B0]  # 0 without an observer
    demand.desired_pressure_kpa = min(max(desired, 0.0), g.desired_max_kpa)
    demand.error = error
    demand.s1 = error_rate
    demand.s2 = measurement.chamber_kpa - demand.desired_pressure_kpa
    demand.flow_kpa_s = -g.pressure_gain * demand.s2
    demand.mode = choose_mode(gains.actuation, reference, error, demand.flow_kpa_s, state)
