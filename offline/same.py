"""Are two logs the same run? Channel by channel, sender by sender, byte by byte, but for wall-clock stamps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softloop.offline.log import Log, Records
from softloop.wire.channels import CAN, CHANNELS
from softloop.wire.mcap_layout import SENDER_FIELDS

WALL_SUFFIX = "_wall_ns"


@dataclass(frozen=True)
class Apart:
    """The first place at which two series differ: which series, message number from 0, field, and both values."""

    series: str
    message: int
    field: str
    first: str
    second: str

    def __str__(self) -> str:
        if self.field == "":
            return f"{self.series}: {self.first} messages and {self.second}"
        return f"{self.series}: message {self.message}, field {self.field}: {self.first} and {self.second}"


def series_of(log: Log) -> dict[str, Records]:
    """Every channel of a log; where several senders share one, each sender's messages for themselves, in their order."""
    found: dict[str, Records] = {}
    for channel in CHANNELS:
        if not channel.logged or channel is CAN:
            continue
        records, sender = log[channel.name], SENDER_FIELDS.get(channel.message)
        if sender is None:
            found[channel.name] = records
            continue
        for number in np.unique(records[sender]).tolist():
            found[f"{channel.name} of {sender} {number}"] = records[records[sender] == number]
    for (bus, number), frames in log.can.items():
        found[f"can/{bus}/{number:x}"] = frames
    return found


def differences(a: Log, b: Log) -> list[Apart]:
    """The first difference of each series that is not the same in both logs; empty when they are one run."""
    of_a, of_b = series_of(a), series_of(b)
    found = []
    for name in sorted({*of_a, *of_b}):
        apart = compare(name, of_a.get(name), of_b.get(name))
        found.extend([apart] if apart else [])
    return found


def compare(name: str, a: Records | None, b: Records | None) -> Apart | None:
    """The first difference of two series of records."""
    count_a, count_b = 0 if a is None else len(a), 0 if b is None else len(b)
    if a is not None and b is not None:
        n = min(count_a, count_b)
        places = [_first_of_field(a[field][:n], b[field][:n]) for field in _fields(a)]
        at = min((place for place in places if place is not None), default=None)
        if at is not None:
            field = _fields(a)[places.index(at)]
            return Apart(name, at, field, _shown(a[field][at]), _shown(b[field][at]))
    return None if count_a == count_b else Apart(name, min(count_a, count_b), "", str(count_a), str(count_b))


def _fields(records: Records) -> list[str]:
    return [name for name in records.dtype.names or () if not name.endswith(WALL_SUFFIX)]


def _first_of_field(a: NDArray[Any], b: NDArray[Any]) -> int | None:
    """The first place at which the bytes differ: NaN equals the same NaN, 0.0 does not equal -0.0."""
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    bytes_a, bytes_b = (x.view(np.uint8).reshape(len(x), -1) if len(x) else np.zeros((0, 1), np.uint8) for x in (a, b))
    differs = (bytes_a != bytes_b).any(axis=1)
    return int(np.argmax(differs)) if differs.any() else None


def _shown(value: Any) -> str:
    return str(value.tolist())
