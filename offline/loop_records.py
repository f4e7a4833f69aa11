"""The records of the closed loop in one process: how its parts are linked, and what is under way between them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from softloop.devices.gate import GATE_CONFIG, GATE_INPUT, GATE_OUTPUT, GATE_STATE
from softloop.devices.gate_messages import COMMAND, FRAME
from softloop.devices.protocols.analog import ANALOG_CONFIG, ANALOG_STATE
from softloop.devices.protocols.wt931 import SAMPLER_CONFIG, SAMPLER_STATE
from softloop.plant.records import EVENT
from softloop.wire.kernel import kernel, record_dtype, record_type
from softloop.wire.messages import message

UNDER_WAY = 512  # of one device; at 200 Hz enough for 2.5 s of added delay

# A pressure sensor as `[pressures]` describes it.
SHEET = record_dtype([("zero_v", "f8"), ("full_v", "f8"), ("span_kpa", "f8")])
LINK = record_dtype(
    [
        ("latency_ns", "i8"),  # from a tick to its valve frame
        ("valve_frame_ns", "i8"),  # time of the frames on their wires
        ("driver_frame_ns", "i8"),
        ("analog_frame_ns", "i8"),
        ("sample_bytes_ns", "i8"),
        ("arm_ns", "i8"),
        ("disarm_ns", "i8"),
        ("direction", "i8"),
        ("zero_deg", "f8"),
        ("supply", SHEET),
        ("chamber", SHEET),
        ("analog", ANALOG_CONFIG),
        ("sampler", SAMPLER_CONFIG),
        ("gate", GATE_CONFIG),
    ]
)
FIFO = record_dtype([("events", EVENT, (UNDER_WAY,)), ("head", "i8"), ("waiting", "i8")])
# The adapters' and the gate's own memory.
BETWEEN = record_dtype(
    [
        ("analog_way", FIFO),
        ("serial_way", FIFO),
        ("driver_way", FIFO),
        ("analog", ANALOG_STATE),
        ("sampler", SAMPLER_STATE),
        ("gate", GATE_STATE),
        ("given", GATE_INPUT),
        ("output", GATE_OUTPUT),
        ("command", COMMAND),
        ("frame", FRAME),
        ("inclination_seq", "i8"),
        ("requests", "i8"),  # taken so far
        ("truths", "i8"),
        ("pressures", "i8"),
        ("inclinations", "i8"),
    ]
)
TRUTH = message("PlantTruth").dtype
PRESSURE, INCLINATION = message("PressureSample").dtype, message("InclinationSample").dtype
VALVE_STATUS = message("ValveStatus").dtype

EVENT_TYPE, FIFO_TYPE = record_type(EVENT), record_type(FIFO)
LINK_TYPE, BETWEEN_TYPE, SHEET_TYPE = record_type(LINK), record_type(BETWEEN), record_type(SHEET)
TRUTH_TYPE, STATUS_TYPE = record_type(TRUTH), record_type(VALVE_STATUS)
PRESSURE_TYPE, INCLINATION_TYPE = record_type(PRESSURE), record_type(INCLINATION)


@kernel(types.void(FIFO_TYPE, EVENT_TYPE))
def push(fifo: Any, event: Any) -> None:
    """Put what is under way behind the others; when full, it is lost."""
    if fifo.waiting < UNDER_WAY:
        fifo.events[(fifo.head + fifo.waiting) % UNDER_WAY] = event
        fifo.waiting += 1


@kernel(types.b1(FIFO_TYPE, types.i8))
def arrived(fifo: Any, now_ns: int) -> bool:
    """Whether the oldest has arrived by `now_ns`."""
    return bool(fifo.waiting > 0 and fifo.events[fifo.head].end_ns <= now_ns)


@kernel(types.void(FIFO_TYPE))
def drop_first(fifo: Any) -> None:
    """The oldest has been taken."""
    fifo.head = (fifo.head + 1) % UNDER_WAY
    fifo.waiting -= 1


def no_records(dtype: np.dtype[Any]) -> Any:
    """An array of none, for what is not to be kept."""
    return np.zeros(0, dtype)
