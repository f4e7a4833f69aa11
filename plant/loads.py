"""Payload and contact, coming and going by schedule."""

from __future__ import annotations

from math import pi
from typing import Any

import numpy as np
from numba import types

from softloop.plant.mechanics import GRAVITY_M_S2
from softloop.plant.records import EVENT_LOAD, EVENTS_TYPE, LOAD_CONTACT, LOAD_PAYLOAD, MAX_LOADS, PLANT_TYPE, STATE_TYPE
from softloop.wire.kernel import kernel

_NEVER_NS = np.iinfo(np.int64).max


@kernel(types.void(PLANT_TYPE, STATE_TYPE))
def _combine(params: Any, state: Any) -> None:
    """What hangs on the actuator now: payloads add up, of several contacts the last in the schedule holds.

    The payload's equivalent is m g l / J, so that its share of the inertia, m l^2 / J, is that times l / g.
    """
    memory = state.memory
    memory.payload_deg_s2, memory.contact_1_s2, memory.contact_deg = 0.0, 0.0, 0.0
    for i in range(MAX_LOADS):
        if state.load_on[i] and params.loads[i].kind == LOAD_PAYLOAD:
            memory.payload_deg_s2 += params.loads[i].magnitude
        elif state.load_on[i] and params.loads[i].kind == LOAD_CONTACT:
            memory.contact_1_s2, memory.contact_deg = params.loads[i].magnitude, params.loads[i].angle_deg
    memory.inertia = 1.0 + memory.payload_deg_s2 * (pi / 180.0) * params.mechanics.payload_arm_m / GRAVITY_M_S2


@kernel(types.void(PLANT_TYPE, STATE_TYPE))
def plan_loads(params: Any, state: Any) -> None:
    """Find the next change after `state.t_ns`."""
    state.next_load_ns = _NEVER_NS
    for i in range(MAX_LOADS):
        if params.loads[i].kind != 0:
            for at_ns in (state.start_ns + params.loads[i].on_ns, state.start_ns + params.loads[i].off_ns):
                if at_ns > state.t_ns:
                    state.next_load_ns = min(state.next_load_ns, at_ns)


@kernel(types.i8(PLANT_TYPE, STATE_TYPE, EVENTS_TYPE, types.i8))
def change_loads(params: Any, state: Any, events: np.ndarray, n: int) -> int:
    """Bring loads up to date at `state.t_ns`; one event for each that came or left. The rate does not jump."""
    now_ns = state.t_ns - state.start_ns
    for i in range(MAX_LOADS):
        plan = params.loads[i]
        on = plan.kind != 0 and plan.on_ns <= now_ns < plan.off_ns
        if on != (state.load_on[i] != 0):
            state.load_on[i] = 1 if on else 0
            event = events[n]
            event.kind, event.sample_ns, event.end_ns, event.value = EVENT_LOAD, state.t_ns, state.t_ns, plan.magnitude
            event.raw[0], event.raw[1], event.raw[2], event.raw[3] = state.load_on[i], plan.kind, i, 0
            n += 1
    _combine(params, state)
    plan_loads(params, state)
    return n
