"""The safety gate: the last judgement before current flows. One pure step function; `valves` gives it time and wires.

States and what leads where, as `NEXT` holds it. An event is what one step found; when several are there, the leftmost counts.

| state    | STOP  | CONDITION | DISARM   | ARM   | nothing  |
|----------|-------|-----------|----------|-------|----------|
| DISARMED | FAULT | DISARMED  | DISARMED | ARMED | DISARMED |
| ARMED    | FAULT | FAULT     | DISARMED | ARMED | ARMED    |
| FAULT    | FAULT | FAULT     | FAULT    | ARMED | FAULT    |

- STOP: a stop request, of a person or of the monitor, held or not. DISARM: a request, or the process is about to end.
- CONDITION: any of the reasons of `condition`: no arming while one holds, and FAULT when it comes up while armed.
- ARM: an arm request that was not seen before (a new number of its requester) and answers a word that this gate said less than
  `ARM_AGE_NS` ago. It is used up by the step that sees it: one that was refused has to be made anew.

Outputs: ARMED passes the command's currents, limited. DISARMED and FAULT vent (charge 0, exhaust at its open current) until
the chamber is known to be empty or a time limit has passed, then close both valves; they vent again when pressure is seen to
come back.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import types

from softloop.devices.config import PERIOD_NS, ValvesProcess
from softloop.devices.protocols.quantise_kernels import counts_to_current, current_to_counts
from softloop.wire.kernel import array_of, kernel, new_record, record_dtype, record_type
from softloop.wire.messages import constant

_I8, _F8 = np.int64, np.float64


def _word(name: str) -> int:
    return constant("ValveStatus", name)


GATE_DISARMED, GATE_ARMED, GATE_FAULT = _word("GATE_DISARMED"), _word("GATE_ARMED"), _word("GATE_FAULT")
OUTPUT_VENT, OUTPUT_PASS, OUTPUT_CLOSED = _word("OUTPUT_VENT"), _word("OUTPUT_PASS"), _word("OUTPUT_CLOSED")
REASON_NONE = _word("REASON_NONE")
REASON_COMMAND_SILENT = _word("REASON_COMMAND_SILENT")
REASON_SENSOR_STALE = _word("REASON_SENSOR_STALE")
REASON_NOT_FINITE = _word("REASON_NOT_FINITE")
REASON_OUT_OF_RANGE = _word("REASON_OUT_OF_RANGE")
REASON_OVER_PRESSURE = _word("REASON_OVER_PRESSURE")
REASON_OVER_ANGLE = _word("REASON_OVER_ANGLE")
REASON_CONTROLLER_LOST = _word("REASON_CONTROLLER_LOST")
REASON_SENSOR_LOST = _word("REASON_SENSOR_LOST")
REASON_BUS_OFF = _word("REASON_BUS_OFF")
REASON_EMERGENCY_STOP = _word("REASON_EMERGENCY_STOP")
REASON_DRIVER_SILENT = _word("REASON_DRIVER_SILENT")
REASON_REQUEST = _word("REASON_REQUEST")
REASON_NOT_READY = _word("REASON_NOT_READY")
REASON_SHUTDOWN = _word("REASON_SHUTDOWN")
REASON_INVARIANT = _word("REASON_INVARIANT")
REASON_OLD_REQUEST = _word("REASON_OLD_REQUEST")
DRIVER_OK, DRIVER_WATCHDOG, DRIVER_SILENT = _word("DRIVER_OK"), _word("DRIVER_WATCHDOG"), _word("DRIVER_SILENT")

EVENT_STOP, EVENT_CONDITION, EVENT_DISARM, EVENT_ARM, EVENT_NOTHING = range(5)


def _next_states() -> np.ndarray:
    disarmed = [GATE_FAULT, GATE_DISARMED, GATE_DISARMED, GATE_ARMED, GATE_DISARMED]
    armed = [GATE_FAULT, GATE_FAULT, GATE_DISARMED, GATE_ARMED, GATE_ARMED]
    fault = [GATE_FAULT, GATE_FAULT, GATE_FAULT, GATE_ARMED, GATE_FAULT]
    return np.array([disarmed, armed, fault])


NEXT = _next_states()
"""New state by state (row) and event (column): the table above."""

STOP_ASKED, STOP_INVARIANT = 1, 2  # bits of `stop`: an emergency stop, and a fault asked for by the monitor

LATE_COMMANDS = 40  # a command so many numbers behind the last one came late by another way; farther behind, another counts
# A request that a network held back must not arm the rig when nobody asks any more; on this clock, whatever the requester's says.
ARM_AGE_NS = 1_000_000_000
REQUESTERS = 8  # whose last arm request is remembered, each at least for ARM_AGE_NS: what is forgotten is too old to arm

GATE_CONFIG = record_dtype([
    ("silence_ns", _I8),            # a command is due every period; when none came for this long, it is silent
    ("pressure_age_ns", _I8),
    ("inclination_age_ns", _I8),
    ("driver_silence_ns", _I8),
    ("vent_time_ns", _I8),
    ("vent_settle_ns", _I8),
    ("current_max_ma", _F8),
    ("slew_ma", _F8),               # per step
    ("overlap_ma", _F8),
    ("vent_current_ma", _F8),
    ("vent_done_kpa", _F8),
    ("vent_again_kpa", _F8),
    ("pressure_max_kpa", _F8),
    ("angle_min_deg", _F8),
    ("angle_max_deg", _F8),
])  # fmt: skip

GATE_INPUT = record_dtype([
    ("now_ns", _I8),
    ("command_new", _I8),           # 1: the fields of ValveCommand below are of a command not given before
    ("command_received_ns", _I8),
    ("command_seq", _I8),
    ("pressure_stamp_ns", _I8),
    ("inclination_stamp_ns", _I8),
    ("chamber_pressure_kpa", _F8),
    ("angle_deg", _F8),
    ("charge_current_ma", _F8),
    ("exhaust_current_ma", _F8),
    ("ready", _I8),
    ("stop", _I8),                  # STOP_ASKED, STOP_INVARIANT or both: such requests came
    ("disarm", _I8),
    ("arm", _I8),                   # 1: an arm request came, of this requester and number
    ("arm_origin", _I8),
    ("arm_seq", _I8),
    ("arm_stamp_ns", _I8),          # of the gate's word that it answers
    ("shutdown", _I8),              # 1: the process is about to end
    ("bus_off", _I8),
    ("driver", _I8),                # ValveStatus DRIVER_* of the last good status frame
    ("driver_stamp_ns", _I8),       # its arrival; 0 for none yet
])  # fmt: skip

GATE_STATE = record_dtype([
    ("steps", _I8),
    ("gate", _I8),
    ("reason", _I8),                # why the gate is in this state
    ("command_seq", _I8),
    ("command_received_ns", _I8),   # 0: there was no command yet
    ("command_reason", _I8),        # what is wrong with the last command
    ("charge_asked_ma", _F8),
    ("exhaust_asked_ma", _F8),
    ("chamber_pressure_kpa", _F8),
    ("pressure_stamp_ns", _I8),
    ("venting", _I8),
    ("vent_since_ns", _I8),
    ("empty_since_ns", _I8),        # 0: the chamber is not known to be empty
    ("charge_ma", _F8),             # as sent last
    ("exhaust_ma", _F8),
    ("arm_origin", _I8, (REQUESTERS,)),
    ("arm_seq", _I8, (REQUESTERS,)),
    ("arm_heard_ns", _I8, (REQUESTERS,)),
    ("requesters", _I8),            # how many are remembered
])  # fmt: skip

GATE_OUTPUT = record_dtype([
    ("gate", _I8),
    ("output", _I8),
    ("reason", _I8),
    ("changed", _I8),               # 1: state or reason are not what they were
    ("refused", _I8),               # why an arm request of this step was refused; 0 for no such
    ("driver", _I8),                # DRIVER_* as judged now
    ("charge_counts", _I8),
    ("exhaust_counts", _I8),
    ("charge_current_ma", _F8),     # what the counts mean
    ("exhaust_current_ma", _F8),
])  # fmt: skip

_CONFIG, _INPUT, _STATE, _OUTPUT = (record_type(d) for d in (GATE_CONFIG, GATE_INPUT, GATE_STATE, GATE_OUTPUT))


def gate_config(process: ValvesProcess) -> Any:
    """A GATE_CONFIG record."""
    valves = process.valves
    config = new_record(GATE_CONFIG)
    # The command is held on `hold_ticks` further ticks; on the next one it is silent.
    config.silence_ns = (valves.hold_ticks + 1) * PERIOD_NS
    config.pressure_age_ns, config.inclination_age_ns = process.pressure_age_ns, process.inclination_age_ns
    config.driver_silence_ns = round(valves.driver_silence_ms * 1e6)
    config.vent_time_ns = round(valves.vent_time_s * 1e9)
    config.vent_settle_ns = round(valves.vent_settle_s * 1e9)
    config.slew_ma = valves.slew_ma_per_tick
    for name in ("current_max_ma", "overlap_ma", "vent_current_ma", "vent_done_kpa", "vent_again_kpa", "pressure_max_kpa"):
        config[name] = getattr(valves, name)
    config.angle_min_deg, config.angle_max_deg = valves.angle_min_deg, valves.angle_max_deg
    return config


@kernel(types.i8(_CONFIG, _STATE, _INPUT))
def command_reason(config: Any, state: Any, given: Any) -> int:
    """What is wrong with a new command: a REASON_*, REASON_NONE when all is well."""
    pressure_age_ns = given.command_received_ns - given.pressure_stamp_ns
    inclination_age_ns = given.command_received_ns - given.inclination_stamp_ns
    charge, exhaust = given.charge_current_ma, given.exhaust_current_ma
    if not (math.isfinite(charge) and math.isfinite(exhaust)):
        return REASON_NOT_FINITE
    if given.ready == 0:
        return REASON_NOT_READY
    if not (math.isfinite(given.chamber_pressure_kpa) and math.isfinite(given.angle_deg)):
        return REASON_NOT_FINITE
    if given.pressure_stamp_ns <= 0 or given.inclination_stamp_ns <= 0:
        return REASON_SENSOR_LOST
    # A stamp of the future is of no clock of this rig.
    if not (0 <= pressure_age_ns <= config.pressure_age_ns and 0 <= inclination_age_ns <= config.inclination_age_ns):
        return REASON_SENSOR_STALE
    if given.chamber_pressure_kpa > config.pressure_max_kpa:
        return REASON_OVER_PRESSURE
    if not config.angle_min_deg <= given.angle_deg <= config.angle_max_deg:
        return REASON_OVER_ANGLE
    if not (0.0 <= charge <= config.current_max_ma and 0.0 <= exhaust <= config.current_max_ma):
        return REASON_OUT_OF_RANGE
    if given.command_seq <= state.command_seq:
        return REASON_CONTROLLER_LOST  # it counts anew: another controller, which does not know this state
    return REASON_NONE


@kernel(types.void(_CONFIG, _STATE, _INPUT))
def take_command(config: Any, state: Any, given: Any) -> None:
    """Judge a new command and keep what later steps need of it; one that others have overtaken says nothing any more."""
    if 0 <= state.command_seq - given.command_seq < LATE_COMMANDS and state.command_received_ns > 0:
        return
    state.command_reason = command_reason(config, state, given)
    state.command_seq = given.command_seq
    state.command_received_ns = given.command_received_ns
    if state.command_reason == REASON_NONE:
        state.charge_asked_ma = given.charge_current_ma
        state.exhaust_asked_ma = given.exhaust_current_ma
    if math.isfinite(given.chamber_pressure_kpa) and 0 < given.pressure_stamp_ns <= given.command_received_ns:
        state.chamber_pressure_kpa = given.chamber_pressure_kpa
        state.pressure_stamp_ns = given.pressure_stamp_ns


@kernel(types.i8(_CONFIG, _INPUT))
def driver_now(config: Any, given: Any) -> int:
    """DRIVER_* of the valve driver; silent when its last good word is too old."""
    heard = given.driver_stamp_ns > 0 and given.now_ns - given.driver_stamp_ns <= config.driver_silence_ns
    return given.driver if heard else DRIVER_SILENT


@kernel(types.i8(_CONFIG, _STATE, _INPUT))
def condition(config: Any, state: Any, given: Any) -> int:
    """Why no current may pass now: a REASON_*, REASON_NONE when it may."""
    if given.bus_off != 0:
        return REASON_BUS_OFF
    # A driver that vents by itself does not hear the gate either.
    if driver_now(config, given) != DRIVER_OK:
        return REASON_DRIVER_SILENT
    if state.command_received_ns == 0:
        return REASON_CONTROLLER_LOST
    if given.now_ns - state.command_received_ns >= config.silence_ns:
        return REASON_COMMAND_SILENT
    return state.command_reason


@kernel(types.b1(_STATE, types.i8, types.i8, types.i8))
def arm_is_new(state: Any, origin: int, seq: int, now_ns: int) -> bool:
    """Whether this arm request was not seen before; it is noted as seen. It is not taken where nobody can be forgotten for it."""
    place = state.requesters
    for i in range(state.requesters):
        if state.arm_origin[i] == origin:
            newer = seq > state.arm_seq[i]
            state.arm_seq[i], state.arm_heard_ns[i] = max(seq, state.arm_seq[i]), now_ns
            return newer
        if state.requesters == REQUESTERS and (i == 0 or state.arm_heard_ns[i] < state.arm_heard_ns[place]):
            place = i
    if state.requesters < REQUESTERS:
        state.requesters += 1
    elif now_ns - state.arm_heard_ns[place] <= ARM_AGE_NS:
        return False
    state.arm_origin[place], state.arm_seq[place], state.arm_heard_ns[place] = origin, seq, now_ns
    return True


@kernel(types.void(_CONFIG, _STATE, _INPUT, _OUTPUT))
def change_state(config: Any, state: Any, given: Any, output: Any) -> None:
    """Find this step's event and go where the table says."""
    late = given.arm != 0 and not 0 <= given.now_ns - given.arm_stamp_ns <= ARM_AGE_NS
    asked = given.arm != 0 and not late and arm_is_new(state, given.arm_origin, given.arm_seq, given.now_ns)
    reason = condition(config, state, given)
    before, why_before = state.gate, state.reason
    event = EVENT_NOTHING
    if given.stop != 0:
        event, reason = EVENT_STOP, REASON_EMERGENCY_STOP if given.stop & STOP_ASKED else REASON_INVARIANT
    elif reason != REASON_NONE:
        event = EVENT_CONDITION
    elif given.shutdown != 0 or given.disarm != 0:
        event, reason = EVENT_DISARM, REASON_SHUTDOWN if given.shutdown != 0 else REASON_REQUEST
    elif late:
        reason = REASON_OLD_REQUEST
    elif asked:
        event = EVENT_ARM
    state.gate = NEXT[before, event]
    if state.gate != before or event == EVENT_STOP:
        state.reason = reason
    output.changed = state.gate != before or state.reason != why_before
    output.refused = reason if asked or late else REASON_NONE  # of an event ARM it is REASON_NONE
    if state.gate != before and state.gate != GATE_ARMED:
        state.venting, state.vent_since_ns = 1, given.now_ns


@kernel(types.i8(_CONFIG, _STATE, _INPUT))
def vent_output(config: Any, state: Any, given: Any) -> int:
    """OUTPUT_VENT or OUTPUT_CLOSED of a gate that is not armed."""
    fresh = state.pressure_stamp_ns > 0 and given.now_ns - state.pressure_stamp_ns <= config.pressure_age_ns
    high = fresh and state.chamber_pressure_kpa > config.vent_again_kpa
    if not (fresh and state.chamber_pressure_kpa <= config.vent_done_kpa):
        state.empty_since_ns = 0
    elif state.empty_since_ns == 0:
        state.empty_since_ns = given.now_ns
    empty = state.empty_since_ns > 0 and given.now_ns - state.empty_since_ns >= config.vent_settle_ns
    if state.venting == 0 and high:
        state.venting, state.vent_since_ns = 1, given.now_ns
    elif state.venting == 1 and (empty or (given.now_ns - state.vent_since_ns >= config.vent_time_ns and not high)):
        state.venting = 0
    return OUTPUT_VENT if state.venting == 1 else OUTPUT_CLOSED


@kernel(types.f8(types.f8, types.f8, types.f8, types.f8))
def limited(asked_ma: float, sent_ma: float, slew_ma: float, max_ma: float) -> float:
    """A current within its range and within one step's change of what was sent last."""
    return min(max(asked_ma, sent_ma - slew_ma, 0.0), sent_ma + slew_ma, max_ma)


@kernel(types.void(_CONFIG, _STATE, _INPUT, _OUTPUT))
def gate_step(config: Any, state: Any, given: Any, output: Any) -> None:
    """One valve frame: judge what was given, change the state, choose the currents.

    Args:
        config: GATE_CONFIG, from `gate_config`. state: GATE_STATE, zeroed at the start. given: GATE_INPUT.
        output: GATE_OUTPUT, all fields written.
    """
    if state.steps == 0:
        state.venting, state.vent_since_ns = 1, given.now_ns
    state.steps += 1
    if given.command_new != 0:
        take_command(config, state, given)
    change_state(config, state, given, output)
    charge, exhaust = 0.0, 0.0
    if state.gate == GATE_ARMED:
        output.output = OUTPUT_PASS
        charge = limited(state.charge_asked_ma, state.charge_ma, config.slew_ma, config.current_max_ma)
        exhaust = limited(state.exhaust_asked_ma, state.exhaust_ma, config.slew_ma, config.current_max_ma)
        if exhaust > config.overlap_ma:
            charge = min(charge, config.overlap_ma)
    else:
        output.output = vent_output(config, state, given)
        if output.output == OUTPUT_VENT:
            exhaust = config.vent_current_ma
    output.gate, output.reason = state.gate, state.reason
    output.driver = driver_now(config, given)
    output.charge_counts, output.exhaust_counts = current_to_counts(charge), current_to_counts(exhaust)
    output.charge_current_ma = counts_to_current(output.charge_counts)
    output.exhaust_current_ma = counts_to_current(output.exhaust_counts)
    state.charge_ma, state.exhaust_ma = output.charge_current_ma, output.exhaust_current_ma


@kernel(types.void(array_of(_CONFIG), array_of(_STATE), array_of(_INPUT), array_of(_OUTPUT)))
def gate_step_of_arrays(config: np.ndarray, state: np.ndarray, given: np.ndarray, output: np.ndarray) -> None:
    """`gate_step` on arrays of one record each: from Python a call with arrays costs a third of one with records."""
    gate_step(config[0], state[0], given[0], output[0])
