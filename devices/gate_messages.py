"""Between the gate's records and the messages on the wire: a command in, the word on a valve frame out."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from softloop.devices.gate import GATE_INPUT, GATE_OUTPUT, GATE_STATE
from softloop.devices.protocols.quantise_kernels import counts_to_current
from softloop.wire.kernel import array_of, kernel, record_dtype, record_type
from softloop.wire.messages import message

COMMAND, STATUS = message("ValveCommand").dtype, message("ValveStatus").dtype
_INT63 = 2**63 - 1  # what of a sender's number the gate compares

# What the process knows of a frame beside the gate's records.
FRAME = record_dtype(
    [
        ("seq", "i8"),
        ("stamp_ns", "i8"),
        ("tick", "u8"),
        ("charge_coil", "i8"),  # counts that the driver measured last; below 0: it says none
        ("exhaust_coil", "i8"),
        ("rejected", "i8"),
    ]
)
INPUT_TYPE, STATE_TYPE, OUTPUT_TYPE = record_type(GATE_INPUT), record_type(GATE_STATE), record_type(GATE_OUTPUT)
COMMAND_TYPE, STATUS_TYPE, FRAME_TYPE = record_type(COMMAND), record_type(STATUS), record_type(FRAME)


@kernel(types.void(INPUT_TYPE, COMMAND_TYPE, types.i8))
def give_command(given: Any, command: Any, received_ns: int) -> None:
    """A command that came at `received_ns`, not given before, into the gate's input."""
    given.command_new, given.command_received_ns, given.command_seq = 1, received_ns, np.int64(command.seq & _INT63)
    given.pressure_stamp_ns, given.inclination_stamp_ns = command.pressure_stamp_ns, command.inclination_stamp_ns
    given.chamber_pressure_kpa, given.angle_deg = command.chamber_pressure_kpa, command.angle_deg
    given.charge_current_ma, given.exhaust_current_ma = command.charge_current_ma, command.exhaust_current_ma
    given.ready = command.ready


@kernel(types.void(FRAME_TYPE, INPUT_TYPE, STATE_TYPE, OUTPUT_TYPE, STATUS_TYPE))
def fill_status(frame: Any, given: Any, state: Any, output: Any, status: Any) -> None:
    """The `ValveStatus` of one valve frame, all fields written."""
    answered = given.command_new != 0 and given.command_seq == state.command_seq  # not one that was overtaken
    status.seq, status.stamp_ns, status.tick, status.rejected = frame.seq, frame.stamp_ns, frame.tick, frame.rejected
    status.command_seq = given.command_seq if answered else 0
    status.command_received_ns, status.driver_stamp_ns = given.command_received_ns, given.driver_stamp_ns
    status.charge_current_ma, status.exhaust_current_ma = output.charge_current_ma, output.exhaust_current_ma
    status.charge_coil_ma = counts_to_current(frame.charge_coil) if frame.charge_coil >= 0 else np.nan
    status.exhaust_coil_ma = counts_to_current(frame.exhaust_coil) if frame.exhaust_coil >= 0 else np.nan
    status.gate, status.output, status.reason, status.driver = output.gate, output.output, output.reason, output.driver


@kernel(types.void(array_of(INPUT_TYPE), array_of(COMMAND_TYPE), types.i8))
def give_command_of_arrays(given: np.ndarray, command: np.ndarray, received_ns: int) -> None:
    """`give_command` on arrays of one record each, which Python hands over faster."""
    give_command(given[0], command[0], received_ns)


@kernel(
    types.void(array_of(FRAME_TYPE), array_of(INPUT_TYPE), array_of(STATE_TYPE), array_of(OUTPUT_TYPE), array_of(STATUS_TYPE))
)
def fill_status_of_arrays(
    frame: np.ndarray, given: np.ndarray, state: np.ndarray, output: np.ndarray, status: np.ndarray
) -> None:
    """`fill_status` likewise."""
    fill_status(frame[0], given[0], state[0], output[0], status[0])
