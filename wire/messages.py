"""The messages, read once from `msg/*.msg`: CDR bytes, numpy dtypes and constants from one definition.

All fields have a fixed size, so the CDR form of a message (XCDR1, little endian) is a four-byte header and then a C struct:
one `struct.Struct` packs it, one numpy dtype views it. A test holds both equal to what rosbags writes.
"""

from __future__ import annotations

import struct
from collections import namedtuple
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg

from softloop.wire.errors import BadFile

PACKAGE = "softloop_msgs"
MSG_DIR = Path(__file__).resolve().parent / "msg"
CDR_HEADER = b"\x00\x01\x00\x00"
_FORMATS = {
    "uint8": "B", "int8": "b", "bool": "?", "uint16": "H", "int16": "h", "uint32": "I", "int32": "i",
    "uint64": "Q", "int64": "q", "float32": "f", "float64": "d",
}  # fmt: skip


@dataclass(frozen=True)
class Field:
    """One field: its ROS base type, its length (0 for a scalar) and its offset after the CDR header."""

    name: str
    base: str
    length: int
    offset: int

    @property
    def size(self) -> int:
        return struct.calcsize("<" + _FORMATS[self.base]) * max(1, self.length)


class MessageType:
    """One message definition and all that follows from it."""

    def __init__(self, name: str, text: str) -> None:
        self.name = name
        self.text = text
        self.ros_name = f"{PACKAGE}/msg/{name}"
        constants, fields = get_types_from_msg(text, self.ros_name)[self.ros_name]
        self.constants: dict[str, int] = {c[0]: int(c[2]) for c in constants}
        self.fields = _lay_out(fields)
        self.cdr_size = self.fields[-1].offset + self.fields[-1].size
        self.size = len(CDR_HEADER) + self.cdr_size
        self._struct = struct.Struct("<4s" + _struct_format(self.fields))
        self.Tuple: Any = namedtuple(name, [f.name for f in self.fields])  # type: ignore[misc]
        self._zero = tuple((0,) * f.length if f.length else 0 for f in self.fields)
        self._has_arrays = any(f.length for f in self.fields)

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """An aligned record dtype; its first `cdr_size` bytes are the message without the CDR header."""
        spec = [(f.name, _numpy_format(f.base), (f.length,) if f.length else ()) for f in self.fields]
        return np.dtype((np.record, np.dtype(spec, align=True)))

    def make(self, **values: Any) -> Any:
        """A named tuple of this message; fields not given are zero. Raises ValueError on an unknown field."""
        return self.Tuple(*self._zero)._replace(**values)

    def pack(self, message: Any) -> bytes:
        """CDR bytes of a named tuple from `make` or `unpack`. Raises struct.error on a value that does not fit."""
        if not self._has_arrays:
            return self._struct.pack(CDR_HEADER, *message)
        flat: list[Any] = []
        for field, value in zip(self.fields, message, strict=True):
            if field.length:
                flat.extend(value)
            else:
                flat.append(value)
        return self._struct.pack(CDR_HEADER, *flat)

    def unpack(self, payload: bytes) -> Any:
        """The named tuple in `payload`. Raises BadPayload when it is not this message."""
        self.check(payload)
        values = self._struct.unpack(payload)[1:]
        return self.Tuple(*values) if not self._has_arrays else self.Tuple(*self._regroup(values))

    def _regroup(self, values: tuple[Any, ...]) -> list[Any]:
        grouped: list[Any] = []
        at = 0
        for field in self.fields:
            grouped.append(values[at : at + field.length] if field.length else values[at])
            at += max(1, field.length)
        return grouped

    def check(self, payload: bytes) -> None:
        """Raise BadPayload unless `payload` has this message's length and CDR header."""
        if len(payload) != self.size or payload[:4] != CDR_HEADER:
            raise BadPayload(f"{self.name}: expected {self.size} bytes of little-endian CDR, got {len(payload)}")

    def pack_record(self, record: Any) -> bytes:
        """CDR bytes of one record of `dtype`."""
        return CDR_HEADER + record.tobytes()[: self.cdr_size]

    def unpack_into(self, payload: bytes, target: np.ndarray[Any, np.dtype[np.uint8]]) -> None:
        """Copy `payload` into the bytes of a record of `dtype` (a uint8 view). Raises BadPayload as `unpack` does."""
        self.check(payload)
        target[: self.cdr_size] = np.frombuffer(payload, np.uint8, offset=len(CDR_HEADER))


class BadPayload(BadFile):
    """Bytes that are not the message which their channel carries."""


def _lay_out(fields: Any) -> list[Field]:
    laid: list[Field] = []
    at = 0
    for name, (node, detail) in fields:
        base, length = (detail[0], 0) if node == Nodetype.BASE else (detail[0][1][0], detail[1])
        if node not in (Nodetype.BASE, Nodetype.ARRAY) or base not in _FORMATS:
            raise BadFile(f"message field '{name}': only numbers and arrays of a fixed length are allowed")
        size = struct.calcsize("<" + _FORMATS[base])
        at = -(-at // size) * size
        laid.append(Field(name, base, length, at))
        at += size * max(1, length)
    return laid


def _struct_format(fields: list[Field]) -> str:
    text, at = "", 0
    for field in fields:
        text += "x" * (field.offset - at) + f"{max(1, field.length)}{_FORMATS[field.base]}"
        at = field.offset + field.size
    return text


def _numpy_format(base: str) -> str:
    return "<" + np.dtype(base).str[1:] if np.dtype(base).itemsize > 1 else np.dtype(base).str


@cache
def message(name: str) -> MessageType:
    """The message called `name`. Raises BadFile when there is no such definition."""
    file = MSG_DIR / f"{name}.msg"
    if not file.is_file():
        raise BadFile(f"no message '{name}'; there are: {', '.join(message_names())}")
    return MessageType(name, file.read_text())


def message_names() -> list[str]:
    return sorted(p.stem for p in MSG_DIR.glob("*.msg"))


def constant(message_name: str, name: str) -> int:
    """A constant declared in a message, such as `constant("ValveStatus", "GATE_ARMED")`."""
    return message(message_name).constants[name]


def names_of(message_name: str, prefix: str) -> dict[int, str]:
    """Value -> lower-case name, without the prefix, of a group of constants: `names_of("ValveStatus", "GATE_")`."""
    found = message(message_name).constants.items()
    return {value: key[len(prefix) :].lower() for key, value in found if key.startswith(prefix)}
