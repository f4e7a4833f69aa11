"""How a run lies in its MCAP file: profile, schemas, channels, times, attachments; and the one writer of such files.

Profile `ros2`; schemas `softloop_msgs/msg/X` with encoding `ros2msg`, which is the text of the `.msg` file; messages in `cdr`,
the very bytes that went over Zenoh. A topic is `/` and the Zenoh key: `/softloop/<bench>/<channel>`, CAN frames
`/softloop/<bench>/can/<bus>/<id in hex>`. A message's sequence is its own `seq`; its log and publish time are the wall time at
which the run started plus the time on the rig clock since then, so that no step of the wall clock can bend a log.

Attachments and a metadata record stand at the start of the file, where the end of the recorder cannot take them away.
"""

from __future__ import annotations

import json
import platform
import struct
import subprocess
import time
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from softloop.wire.channels import CAN, CHANNELS, ROOT, Channel, key
from softloop.wire.mcap_chunks import ChunkedWriter
from softloop.wire.messages import CDR_HEADER, MessageType, message

PROFILE = "ros2"
SCHEMA_ENCODING = "ros2msg"
MESSAGE_ENCODING = "cdr"
METADATA_NAME = "softloop"
CUT_OFF_NAME = "softloop.cut_off"  # metadata of a repaired log whose recorder did not end it: its end is not the run's
LIBRARY = "softloop"
CHUNK_BYTES = 64 * 1024  # closing a chunk of this size takes about a millisecond; one of 1 MiB takes fifteen
# Attached from the run's directory when they stand there; versions.json and git.json are made here.
RUN_FILES = ("bench.toml", "rig.dbc", "parameters.toml", "certificate.json")
MEDIA_TYPES = {".toml": "application/toml", ".json": "application/json"}
LIBRARIES = ("softloop", "numpy", "numba", "eclipse-zenoh")
# Channels on which several senders count for themselves, and the field that tells them apart.
SENDER_FIELDS = {
    "Event": "source",
    "ProcessStatus": "process",
    "GateRequest": "origin",
    "CanFrame": "node",
    "ClockOffset": "host",
}

_HEAD = struct.Struct("<Qq")  # every message begins with seq and stamp_ns
_U64_END = 1 << 64


@dataclass(frozen=True)
class Origin:
    """Where a run starts: the bench, and one instant on both clocks, in ns."""

    bench: str
    wall_ns: int
    clock_ns: int

    def log_time_ns(self, stamp_ns: int) -> int:
        """Wall time of a rig clock stamp."""
        return self.wall_ns + (stamp_ns - self.clock_ns)

    def as_metadata(self) -> dict[str, str]:
        """The metadata record `softloop` of a log."""
        return {"bench": self.bench, "start_wall_ns": str(self.wall_ns), "start_clock_ns": str(self.clock_ns)}


def read_origin(bench: str, clock_now_ns: int) -> Origin:
    """The start of a run, now. The only place where softloop reads the wall clock."""
    return Origin(bench, time.time_ns(), clock_now_ns)


def topic_of_key(full_key: str) -> str:
    """The topic under which messages of a Zenoh key are logged."""
    return f"/{full_key}"


def split_topic(topic: str) -> tuple[str, str, tuple[str, int] | None] | None:
    """Bench, channel name and, for CAN, (bus, arbitration id) of a topic; None when it is none of softloop's."""
    parts = topic.split("/")
    if len(parts) < 4 or parts[0] or parts[1] != ROOT:
        return None
    if parts[3] != CAN.name:
        return (parts[2], parts[3], None) if len(parts) == 4 else None
    number = _hex_number(parts[5]) if len(parts) == 6 else None
    return (parts[2], CAN.name, (parts[4], number)) if number is not None else None


def _hex_number(text: str) -> int | None:
    try:
        number = int(text, 16)
    except ValueError:
        return None
    return number if f"{number:x}" == text else None


def known_channel(bench: str, full_key: str) -> Channel | None:
    """The channel of a key of this bench, or None."""
    parts = split_topic(topic_of_key(full_key))
    if parts is None or parts[0] != bench:
        return None
    return next((c for c in CHANNELS if c.name == parts[1]), None)


class BadMessage(ValueError):
    """A payload that cannot stand on its channel."""


@dataclass(frozen=True)
class _Lane:
    """What is needed to write one topic."""

    channel_id: int
    kind: MessageType
    sender: slice | None  # where in a payload the sender's number stands


class LogWriter:
    """Writes messages into one MCAP file of this layout, given a stream with `write` and `tell`.

    Not thread-safe; errors of the stream pass through.
    """

    def __init__(self, stream: Any, origin: Origin, attachments: Mapping[str, bytes], chunk_bytes: int = CHUNK_BYTES) -> None:
        self.origin = origin
        self._lanes: dict[str, _Lane] = {}
        self._schemas: dict[str, int] = {}
        self._writer = ChunkedWriter(stream, PROFILE, LIBRARY, chunk_bytes)
        for name, data in attachments.items():
            self._writer.add_attachment(origin.wall_ns, name, media_type(name), data)
        self._writer.add_metadata(METADATA_NAME, origin.as_metadata())
        for channel in CHANNELS:
            if channel.logged and channel is not CAN:
                self._lane(key(origin.bench, channel), channel)

    def add(self, full_key: str, channel: Channel, payload: bytes) -> tuple[int, int]:
        """Write one message; returns its seq and its sender (0 where a channel has one sender only).

        Raises BadMessage on bytes that are not this channel's.
        """
        lane = self._lanes.get(full_key) or self._lane(full_key, channel)
        if len(payload) != lane.kind.size or payload[:4] != CDR_HEADER:
            raise BadMessage(f"{full_key}: {len(payload)} bytes are not a {channel.message}")
        seq, stamp_ns = _HEAD.unpack_from(payload, len(CDR_HEADER))
        log_time = self.origin.log_time_ns(stamp_ns)
        if not 0 <= log_time < _U64_END:
            raise BadMessage(f"{full_key}: stamp {stamp_ns} ns is no time")
        self._writer.add_message(lane.channel_id, log_time, seq & 0xFFFFFFFF, payload)
        return seq, int.from_bytes(payload[lane.sender], "little") if lane.sender else 0

    def _lane(self, full_key: str, channel: Channel) -> _Lane:
        kind = message(channel.message)
        schema = self._schemas.get(kind.ros_name)
        if schema is None:
            schema = self._writer.add_schema(kind.ros_name, SCHEMA_ENCODING, kind.text.encode())
            self._schemas[kind.ros_name] = schema
        channel_id = self._writer.add_channel(topic_of_key(full_key), MESSAGE_ENCODING, schema)
        lane = self._lanes[full_key] = _Lane(channel_id, kind, _sender_bytes(kind))
        return lane

    def flush(self) -> None:
        """Close the chunk in progress, so that everything added so far stands in the stream."""
        self._writer.flush()

    def finish(self) -> None:
        """Write summary and end mark; nothing may be added after."""
        self._writer.finish()


def media_type(name: str) -> str:
    """The media type of an attachment, by the end of its name."""
    return MEDIA_TYPES.get(Path(name).suffix, "text/plain")


def _sender_bytes(kind: MessageType) -> slice | None:
    name = SENDER_FIELDS.get(kind.name)
    if name is None:
        return None
    field = next(f for f in kind.fields if f.name == name)
    at = len(CDR_HEADER) + field.offset
    return slice(at, at + field.size)


def attachments_of(run_dir: Path) -> dict[str, bytes]:
    """What goes into a log beside its messages: the run's files that are there, versions and git state."""
    found = {name: (run_dir / name).read_bytes() for name in RUN_FILES if (run_dir / name).is_file()}
    found["versions.json"] = _json(versions())
    found["git.json"] = _json(git_state(Path(__file__).resolve().parent))
    return found


def versions() -> dict[str, str]:
    """Versions of Python, softloop, the libraries that bear on results, the kernel, and the CPU's name."""
    found = {"python": platform.python_version(), "kernel": platform.release(), "cpu": cpu_model()}
    for name in LIBRARIES:
        try:
            found[name.removeprefix("eclipse-")] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name.removeprefix("eclipse-")] = "unknown"
    return found


def cpu_model() -> str:
    """The CPU's name as Linux gives it, or the machine's architecture."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.machine()
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.machine())


def git_state(folder: Path) -> dict[str, str | bool | None]:
    """Commit and whether files differ from it; both None where `folder` is in no git repository."""
    commit = _git(folder, "rev-parse", "HEAD")
    if commit is None:
        return {"commit": None, "dirty": None}
    return {"commit": commit, "dirty": bool(_git(folder, "status", "--porcelain", "--untracked-files=no"))}


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _json(content: object) -> bytes:
    return (json.dumps(content, indent=2) + "\n").encode()
