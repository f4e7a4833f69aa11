"""The log of a run that was made in this process: the same file layout, and the same messages as at lockstep pace.

All channels that follow from the run are there: samples, commands, the gate's words, cycle records, the plant's truth, and the
gate's transitions as events. CAN frames and what processes say of themselves are not: there were none.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softloop.controller.command import COMMAND, fill_command
from softloop.offline.closed_loop import Trace
from softloop.wire import channels
from softloop.wire.channels import Channel, key
from softloop.wire.errors import BadFile
from softloop.wire.mcap_layout import LogWriter, read_origin
from softloop.wire.messages import CDR_HEADER, constant, message
from softloop.wire.schedule import START_NS

Records = NDArray[Any]
_SOURCE, _KIND = constant("Event", "SOURCE_GATE"), constant("Event", "KIND_GATE")


def write_trace(path: Path, trace: Trace, bench: str, attachments: Mapping[str, bytes]) -> None:
    """Write `trace` as the log of a run of `bench`, in the order of its stamps. Raises BadFile when it cannot be written."""
    lanes = [(channel, records) for channel, records in _lanes(trace) if len(records)]
    stamps = np.concatenate([records["stamp_ns"] for _, records in lanes])
    which = np.repeat(np.arange(len(lanes)), [len(records) for _, records in lanes])
    place = np.concatenate([np.arange(len(records)) for _, records in lanes])
    order = np.argsort(stamps, kind="stable")
    keys = [key(bench, channel) for channel, _ in lanes]
    rows = [_payloads(channel, records) for channel, records in lanes]
    try:
        with path.open("wb") as stream:
            writer = LogWriter(stream, read_origin(bench, START_NS), attachments)
            for lane, row in zip(which[order].tolist(), place[order].tolist(), strict=True):
                writer.add(keys[lane], lanes[lane][0], rows[lane][row])
            writer.finish()
    except OSError as error:
        raise BadFile(f"{path}: cannot be written: {error.strerror or error}") from None


def _lanes(trace: Trace) -> list[tuple[Channel, Records]]:
    return [
        (channels.PRESSURE, trace.pressures),
        (channels.INCLINATION, trace.inclinations),
        (channels.CYCLE, trace.cycles),
        (channels.COMMAND, commands_of(trace.cycles)),
        (channels.VALVES, trace.statuses),
        (channels.EVENT, gate_events(trace.statuses)),
        (channels.TRUTH, trace.truths),
    ]


def _payloads(channel: Channel, records: Records) -> list[bytes]:
    """The CDR bytes of each record."""
    size = message(channel.message).cdr_size
    raw = np.ascontiguousarray(records).view(np.uint8).reshape(len(records), records.dtype.itemsize)[:, :size].tobytes()
    return [CDR_HEADER + raw[at : at + size] for at in range(0, len(raw), size)]


def commands_of(cycles: Records) -> Records:
    """The command of each cycle record, (n,)."""
    found = np.zeros(len(cycles), COMMAND)
    for cycle, command in zip(cycles, found, strict=True):
        fill_command(cycle, command)
    return found


def gate_events(statuses: Records) -> Records:
    """An `Event` for each change of the gate's state or reason, as the process `valves` says it."""
    gate, reason = statuses["gate"].astype(int), statuses["reason"].astype(int)
    changed = np.flatnonzero((np.diff(gate, prepend=gate[:1]) != 0) | (np.diff(reason, prepend=reason[:1]) != 0))
    found = np.zeros(len(changed), message("Event").dtype)
    found["seq"] = np.arange(1, len(changed) + 1)
    found["source"], found["kind"] = _SOURCE, _KIND
    for name in ("stamp_ns", "tick", "reason"):
        found[name] = statuses[name][changed]
    found["code"] = gate[changed]
    return found
