"""What breaks in the simulated rig, coming and going by schedule: sensors, driver, valves, supply, hose.

A fault acts where a real one would: on what the device sends, on what reaches the driver, on the air. Adapters, gate and
controller cannot tell. Faults of one kind that overlap add up where they have a size.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from softloop.plant.records import EVENT_FAULT, EVENTS_TYPE, MAX_FAULTS, PLANT_TYPE, STATE_TYPE
from softloop.wire.kernel import kernel
from softloop.wire.messages import constant, names_of

_NEVER_NS = np.iinfo(np.int64).max
FAULTS = {name: number for number, name in names_of("Event", "FAULT_").items()}
SIZED = ("chamber_bias", "angle_bias", "rate_bias", "noise", "supply_loss", "hose_burst", "charge_leak")
_M2 = 1e-6


def _fault(name: str) -> int:
    return constant("Event", f"FAULT_{name}")


CHAMBER_BIAS, CHAMBER_STUCK, ANALOG_SILENT = _fault("CHAMBER_BIAS"), _fault("CHAMBER_STUCK"), _fault("ANALOG_SILENT")
ANGLE_BIAS, RATE_BIAS, ANGLE_STUCK = _fault("ANGLE_BIAS"), _fault("RATE_BIAS"), _fault("ANGLE_STUCK")
INCLINOMETER_SILENT, NOISE = _fault("INCLINOMETER_SILENT"), _fault("NOISE")
COMMANDS_LOST, DRIVER_SILENT, POWER_LOSS = _fault("COMMANDS_LOST"), _fault("DRIVER_SILENT"), _fault("POWER_LOSS")
SUPPLY_LOSS, HOSE_BURST = _fault("SUPPLY_LOSS"), _fault("HOSE_BURST")
CHARGE_STUCK, EXHAUST_STUCK, CHARGE_LEAK = _fault("CHARGE_STUCK"), _fault("EXHAUST_STUCK"), _fault("CHARGE_LEAK")


@kernel(types.void(PLANT_TYPE, STATE_TYPE))
def plan_faults(params: Any, state: Any) -> None:
    """Find the next change after `state.t_ns`."""
    state.next_fault_ns = _NEVER_NS
    for i in range(MAX_FAULTS):
        if params.faults[i].kind != 0:
            for at_ns in (state.start_ns + params.faults[i].on_ns, state.start_ns + params.faults[i].off_ns):
                if at_ns > state.t_ns:
                    state.next_fault_ns = min(state.next_fault_ns, at_ns)


def begin_faults(params: Any, state: Any, waiting: Any, shift_ns: int) -> None:
    """Let the faults in `waiting`, whose times count from later than the plant's start, be those of the plant from now on.

    Args:
        waiting: a copy of `params.faults`.
        shift_ns: from the plant's start to the instant that their times count from.
    """
    soon_ns = int(state.t_ns) - int(state.start_ns) + 1
    for place, fault in zip(params.faults, waiting, strict=True):
        place["kind"], place["magnitude"] = fault["kind"], fault["magnitude"]
        place["on_ns"], place["off_ns"] = max(soon_ns, fault["on_ns"] + shift_ns), fault["off_ns"] + shift_ns
    plan_faults(params, state)


@kernel(types.void(STATE_TYPE))
def _mend(state: Any) -> None:
    """Nothing is broken."""
    broken = state.broken
    broken.chamber_bias_kpa, broken.angle_bias_deg, broken.rate_bias_deg_s = 0.0, 0.0, 0.0
    broken.noise, broken.supply_lost, broken.burst_m2, broken.charge_leak_m2 = 0.0, 0.0, 0.0, 0.0
    broken.chamber_stuck, broken.analog_silent, broken.angle_stuck, broken.inclinometer_silent = 0, 0, 0, 0
    broken.commands_lost, broken.driver_silent, broken.power_lost = 0, 0, 0
    broken.charge_stuck, broken.exhaust_stuck = 0, 0


@kernel(types.void(STATE_TYPE, types.i8, types.f8))
def _break_sized(state: Any, kind: int, size: float) -> None:
    broken = state.broken
    if kind == CHAMBER_BIAS:
        broken.chamber_bias_kpa += size
    elif kind == ANGLE_BIAS:
        broken.angle_bias_deg += size
    elif kind == RATE_BIAS:
        broken.rate_bias_deg_s += size
    elif kind == NOISE:
        broken.noise += size
    elif kind == SUPPLY_LOSS:
        broken.supply_lost = min(1.0, broken.supply_lost + size)
    elif kind == HOSE_BURST:
        broken.burst_m2 += _M2 * size
    elif kind == CHARGE_LEAK:
        broken.charge_leak_m2 += _M2 * size


@kernel(types.void(STATE_TYPE, types.i8))
def _break(state: Any, kind: int) -> None:
    broken = state.broken
    if kind == CHAMBER_STUCK:
        broken.chamber_stuck = 1
    elif kind == ANALOG_SILENT:
        broken.analog_silent = 1
    elif kind == ANGLE_STUCK:
        broken.angle_stuck = 1
    elif kind == INCLINOMETER_SILENT:
        broken.inclinometer_silent = 1
    elif kind == COMMANDS_LOST:
        broken.commands_lost = 1
    elif kind == DRIVER_SILENT:
        broken.driver_silent = 1
    elif kind == POWER_LOSS:
        broken.power_lost = 1
    elif kind == CHARGE_STUCK:
        broken.charge_stuck = 1
    elif kind == EXHAUST_STUCK:
        broken.exhaust_stuck = 1


@kernel(types.i8(PLANT_TYPE, STATE_TYPE, EVENTS_TYPE, types.i8))
def change_faults(params: Any, state: Any, events: np.ndarray, n: int) -> int:
    """Bring faults up to date at `state.t_ns`; one event for each that came or left."""
    now_ns = state.t_ns - state.start_ns
    _mend(state)
    for i in range(MAX_FAULTS):
        plan = params.faults[i]
        on = plan.kind != 0 and plan.on_ns <= now_ns < plan.off_ns
        if on:
            _break_sized(state, plan.kind, plan.magnitude)
            _break(state, plan.kind)
        if on != (state.fault_on[i] != 0):
            state.fault_on[i] = 1 if on else 0
            event = events[n]
            event.kind, event.sample_ns, event.end_ns, event.value = EVENT_FAULT, state.t_ns, state.t_ns, plan.magnitude
            event.raw[0], event.raw[1], event.raw[2], event.raw[3] = state.fault_on[i], plan.kind, i, 0
            n += 1
    if state.broken.power_lost:  # what held the dump valve shut is gone too
        state.broken.burst_m2 += params.dump_m2
    plan_faults(params, state)
    return n
