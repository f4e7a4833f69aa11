"""What of a tick goes to the gate: the `ValveCommand` in its cycle record."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from softloop.controller.records import CYCLE_TYPE
from softloop.wire.kernel import array_of, kernel, record_type
from softloop.wire.messages import message

COMMAND = message("ValveCommand").dtype
COMMAND_TYPE = record_type(COMMAND)


@kernel(types.void(CYCLE_TYPE, COMMAND_TYPE))
def fill_command(cycle: Any, command: Any) -> None:
    """The command that answers what the tick saw, stamped when it was computed; all fields written."""
    command.seq, command.stamp_ns, command.tick = cycle.seq, cycle.computed_ns, cycle.tick
    command.pressure_stamp_ns, command.inclination_stamp_ns = cycle.pressure_stamp_ns, cycle.inclination_stamp_ns
    command.chamber_pressure_kpa, command.angle_deg = cycle.chamber_pressure_kpa, cycle.angle_deg
    command.charge_current_ma, command.exhaust_current_ma = cycle.charge_current_ma, cycle.exhaust_current_ma
    command.mode, command.ready = cycle.mode, cycle.inputs_valid


@kernel(types.void(array_of(CYCLE_TYPE), array_of(COMMAND_TYPE)))
def fill_command_of_arrays(cycle: np.ndarray, command: np.ndarray) -> None:
    """`fill_command` on arrays of one record each, which Python hands over faster."""
    fill_command(cycle[0], command[0])
