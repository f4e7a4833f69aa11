"""Classic CAN frames: our message `CanFrame`, its bytes, and python-can's `Message`.

Error frames have SocketCAN's form (linux/can/error.h): the arbitration id holds class bits, the data the details. A real
`socketcan` bus and an emulated one are read by the same code.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import can

from softloop.wire.messages import CDR_HEADER, message

_TYPE = message("CanFrame")
FLAG_EXTENDED = _TYPE.constants["FLAG_EXTENDED"]
FLAG_REMOTE = _TYPE.constants["FLAG_REMOTE"]
FLAG_ERROR = _TYPE.constants["FLAG_ERROR"]
_FLAGS = FLAG_EXTENDED | FLAG_REMOTE | FLAG_ERROR

STANDARD_IDS = 1 << 11
EXTENDED_IDS = 1 << 29
MAX_DLC = 8

# Class bits of an error frame's arbitration id, and bits of data[1] for the class CONTROLLER (linux/can/error.h).
ERROR_CONTROLLER = 0x004
ERROR_BUS_OFF = 0x040
ERROR_RESTARTED = 0x100
CONTROLLER_WARNING = 0x04 | 0x08
CONTROLLER_PASSIVE = 0x10 | 0x20
CONTROLLER_ACTIVE = 0x40


class CanFrame(NamedTuple):
    """One frame: the fields of `CanFrame.msg`, with `data` as 8 bytes, zero after the first `dlc`.

    `message("CanFrame").pack` takes it as it is.
    """

    seq: int
    stamp_ns: int
    node: int
    arbitration_id: int
    flags: int
    dlc: int
    data: bytes


def controller_of(node: int) -> int:
    """The number under which the controller of a node on an emulated bus says its error frames; they are counted apart."""
    return node | 1 << 63


def _struct_of_message() -> struct.Struct:
    """The message's layout with its byte array as one item."""
    text, at = "<4s", 0
    for field in _TYPE.fields:
        scalar = {"uint8": "B", "uint32": "I", "int64": "q", "uint64": "Q"}[field.base]
        text += "x" * (field.offset - at) + (f"{field.length}s" if field.length else scalar)
        at = field.offset + field.size
    return struct.Struct(text)


_STRUCT = _struct_of_message()
FRAME_SIZE = _STRUCT.size


def pack_frame(frame: CanFrame) -> bytes:
    """CDR bytes of a frame. Raises struct.error on a value that does not fit its field."""
    return _STRUCT.pack(CDR_HEADER, *frame)


def unpack_frame(payload: bytes) -> CanFrame | None:
    """The frame in `payload`, or None when these bytes are not a frame that could stand on a bus."""
    if len(payload) != FRAME_SIZE:
        return None
    header, *values = _STRUCT.unpack(payload)
    frame = CanFrame._make(values)
    return frame if header == CDR_HEADER and _possible(frame.arbitration_id, frame.flags, frame.dlc) else None


def _possible(arbitration_id: int, flags: int, dlc: int) -> bool:
    limit = EXTENDED_IDS if flags & FLAG_EXTENDED else STANDARD_IDS
    both = FLAG_REMOTE | FLAG_ERROR
    return 0 <= dlc <= MAX_DLC and 0 <= arbitration_id < limit and flags <= _FLAGS and flags & both != both


def make_frame(seq: int, stamp_ns: int, node: int, arbitration_id: int, data: bytes, flags: int = 0) -> CanFrame:
    """A data frame (or, by `flags`, an error frame). Raises ValueError when the id or the data do not fit."""
    if not _possible(arbitration_id, flags, len(data)):
        raise ValueError(f"not a classic CAN frame: id {arbitration_id:#x}, flags {flags}, {len(data)} bytes")
    return CanFrame(seq, stamp_ns, node, arbitration_id, flags, len(data), bytes(data).ljust(MAX_DLC, b"\0"))


def from_message(msg: can.Message, seq: int, stamp_ns: int, node: int) -> CanFrame:
    """A python-can message as a frame; its timestamp is left out. Raises ValueError when it is no classic CAN frame."""
    if msg.is_fd:
        raise ValueError("CAN FD frames are not carried: use classic CAN frames of at most 8 bytes")
    flags = FLAG_EXTENDED * msg.is_extended_id | FLAG_REMOTE * msg.is_remote_frame | FLAG_ERROR * msg.is_error_frame
    dlc = msg.dlc
    if not _possible(msg.arbitration_id, flags, dlc):
        raise ValueError(f"not a classic CAN frame: id {msg.arbitration_id:#x}, dlc {dlc}, flags {flags}")
    # An error frame may be built from its class alone (`dlc=8`, no data): its details are then zero.
    data = b"" if msg.is_remote_frame else bytes(msg.data)
    if len(data) != dlc and not (flags & FLAG_REMOTE or (flags & FLAG_ERROR and dlc == MAX_DLC and not data)):
        raise ValueError(f"the dlc is {dlc}, but there are {len(data)} bytes of data")
    return CanFrame(seq, stamp_ns, node, msg.arbitration_id, flags, dlc, data.ljust(MAX_DLC, b"\0"))


def to_message(frame: CanFrame, channel: str, *, is_rx: bool) -> can.Message:
    """A frame as a python-can message; its timestamp is the rig clock in seconds."""
    flags = frame.flags
    return can.Message(
        timestamp=frame.stamp_ns * 1e-9,
        arbitration_id=frame.arbitration_id,
        is_extended_id=bool(flags & FLAG_EXTENDED),
        is_remote_frame=bool(flags & FLAG_REMOTE),
        is_error_frame=bool(flags & FLAG_ERROR),
        channel=channel,
        dlc=frame.dlc,
        data=bytearray(frame.data[: frame.dlc]),
        is_rx=is_rx,
    )


def state_after(state: can.BusState, frame: CanFrame) -> can.BusState:
    """The bus state once `frame` was seen: error frames of SocketCAN's form change it, others do not."""
    if not frame.flags & FLAG_ERROR:
        return state
    classes = frame.arbitration_id
    if classes & ERROR_BUS_OFF:
        return can.BusState.ERROR
    if classes & ERROR_RESTARTED:
        return can.BusState.ACTIVE
    if classes & ERROR_CONTROLLER:
        detail = frame.data[1]
        if detail & CONTROLLER_PASSIVE:
            return can.BusState.PASSIVE
        if detail & (CONTROLLER_ACTIVE | CONTROLLER_WARNING):
            return can.BusState.ACTIVE
    return state
