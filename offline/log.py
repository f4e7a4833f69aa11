"""Reading a log: one numpy array per channel, whatever state the file is in.

The file is walked record by record; each chunk is checked, its messages are found by one compiled scan, and those of one
channel are copied as rows, so that there is no Python loop per message. Nothing in the file is trusted: a damaged chunk is
left out and named, and where the framing itself is lost reading goes on at the next sound chunk. `Log.problems` says what is
missing.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema, Statistics
from numba import types
from numpy.typing import NDArray

from softloop.offline.log_sound import READ_ONLY, NotSoundError, read_sound
from softloop.offline.mcap_walk import RECORD, FileRecords, decompress, read_attachment
from softloop.wire.channels import CAN, CHANNELS
from softloop.wire.errors import BadFile
from softloop.wire.kernel import array_of, kernel
from softloop.wire.mcap_chunks import MAGIC
from softloop.wire.mcap_layout import CUT_OFF_NAME, METADATA_NAME, SCHEMA_ENCODING, Origin, split_topic
from softloop.wire.messages import CDR_HEADER, PACKAGE, MessageType, message

Records = NDArray[Any]
Bytes = NDArray[np.uint8]
CanKey = tuple[str, int]

_MESSAGE_HEAD = 22  # channel id u16, sequence u32, log time u64, publish time u64
_SORT_BYTES = 4 << 20
# What a damaged record can raise while it is parsed.
DAMAGE = (McapError, struct.error, ValueError, KeyError, RuntimeError, OverflowError, MemoryError, EOFError, zstandard.ZstdError)
_SILENT = {Opcode.HEADER, Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX}
_SILENT |= {Opcode.SUMMARY_OFFSET, Opcode.DATA_END, Opcode.FOOTER}


@dataclass
class Log:
    """A run as it was logged.

    Attributes:
        path: the file.
        origin: bench and the instant of the start on both clocks; None when the file does not say.
        channels: channel name -> structured array, one element per message, in the order of the log.
        can: (bus, arbitration id) -> structured array of `CanFrame`.
        attachments: name -> bytes.
        metadata: name -> text pairs.
        problems: what is damaged or missing, one line each; empty for a whole file.
        finished: the recorder ended the file itself, or the one that this one was repaired from.
    """

    path: Path
    origin: Origin | None = None
    channels: dict[str, Records] = field(default_factory=dict)
    can: dict[CanKey, Records] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    finished: bool = True

    def __getitem__(self, channel: str) -> Records:
        """All messages of a channel, (n,), fields by name; empty when none was logged. Raises BadFile on no such channel."""
        if channel in self.channels:
            return self.channels[channel]
        known = next((c for c in CHANNELS if c.name == channel and c is not CAN), None)
        if known is None:
            names = ", ".join(c.name for c in CHANNELS if c is not CAN)
            raise BadFile(f"no channel '{channel}' in a log; there are: {names}, and CAN frames in .can")
        return np.zeros(0, message(known.message).dtype)

    def text(self, attachment: str) -> str:
        """An attachment as text; empty when it is not there."""
        return self.attachments.get(attachment, b"").decode("utf-8", "replace")

    def table(self, attachment: str) -> dict[str, Any]:
        """A JSON attachment; empty when it is not there or not an object."""
        try:
            content = json.loads(self.text(attachment) or "{}")
        except ValueError:
            return {}
        return content if isinstance(content, dict) else {}

    @property
    def bench(self) -> str:
        return self.origin.bench if self.origin else ""


@kernel(types.i8(READ_ONLY, array_of(types.i8, 2)))
def find_messages(data: Bytes, found: NDArray[np.int64]) -> int:
    """Walk the records of an uncompressed chunk; a row (opcode, channel id or 0, offset of the content, its length) for each.

    Returns the number of rows, or -1 when the records do not fill `data` exactly or `found` is too short.
    """
    at, n = 0, 0
    while at < data.size:
        if at + 9 > data.size or n >= found.shape[0]:
            return -1
        length = 0
        for k in range(7, -1, -1):
            length = length * 256 + int(data[at + 1 + k])
            if length > data.size:
                return -1
        start = at + 9
        if start + length > data.size or (data[at] == 5 and length < 22):
            return -1
        found[n, 0] = data[at]
        found[n, 1] = int(data[start]) + 256 * int(data[start + 1]) if data[at] == 5 else 0
        found[n, 2] = start
        found[n, 3] = length
        n += 1
        at = start + length
    return n


def open_log(path: Path | str) -> Log:
    """Read a log, as far as it can be read; what cannot be is in `Log.problems`.

    Raises BadFile when there is no such file or it is not MCAP at all.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise BadFile(f"{path}: not an MCAP file")
        content: Any = np.memmap(path, np.uint8, "r")
        return _read(path, content)
    except OSError as error:
        raise BadFile(f"{path}: cannot be read: {error.strerror or error}") from None


def _read(path: Path, content: Any) -> Log:
    try:
        return read_sound(LogReader(path), np.frombuffer(content, np.uint8))
    except (NotSoundError, *DAMAGE):
        return LogReader(path).read(memoryview(content))


class LogReader:
    """The state of one reading."""

    def __init__(self, path: Path) -> None:
        self.log = Log(path)
        self.schemas: dict[int, Schema] = {}
        self.topics: dict[int, Channel] = {}
        self.rows: dict[int, list[Bytes]] = {}  # channel id -> blocks (n, payload length), in the order of the file
        self.counts: dict[int, int] | None = None  # as the file's own statistics say
        self._waiting: list[tuple[Bytes, NDArray[np.int64]]] = []  # good chunks with their messages
        self._waiting_bytes, self._found = 0, np.empty((4096, 4), np.int64)
        self._handlers: dict[int, Callable[[bytes], None]] = {
            Opcode.CHUNK: self._chunk,
            Opcode.SCHEMA: self._schema,
            Opcode.CHANNEL: self._channel,
            Opcode.MESSAGE: self._message,
            Opcode.ATTACHMENT: self._attachment,
            Opcode.METADATA: self._metadata,
            Opcode.STATISTICS: self._statistics,
        }

    def read(self, view: memoryview) -> Log:
        records = FileRecords(view)
        for opcode, at, content in records:
            if opcode in _SILENT:
                continue
            if opcode not in self._handlers:
                self._problem(f"unknown record {opcode} at byte {at}, {len(content)} bytes left out")
                continue
            try:
                self._handlers[opcode](bytes(content))
            except DAMAGE as error:
                self._problem(f"damaged {Opcode(opcode).name.lower()} at byte {at}, left out: {_first_line(error)}")
                records.damaged()
        self._say_what_is_cut(records, len(view))
        self._sort_waiting()
        self._resolve()
        self._check_counts()
        return self.log

    def handle(self, opcode: int, content: bytes, *, sure: bool = False) -> None:
        """Take one record, `sure` as in `_schema`. Raises one of DAMAGE, and NotSoundError on one of no known kind."""
        if sure and opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            (self._schema if opcode == Opcode.SCHEMA else self._channel)(content, sure=True)
        elif sure or opcode not in self._handlers or opcode == Opcode.MESSAGE:
            raise NotSoundError
        else:
            self._handlers[opcode](content)

    def described(self) -> tuple[dict[int, Schema], dict[int, Channel]]:
        """What the file has said of its channels so far."""
        return dict(self.schemas), dict(self.topics)

    def _problem(self, text: str) -> None:
        self.log.problems.append(text)

    def _say_what_is_cut(self, records: FileRecords, size: int) -> None:
        for start, end in records.skipped:
            self._problem(f"{end - start} bytes from byte {start} on are no records, left out")
        self.log.finished = records.finished and CUT_OFF_NAME not in self.log.metadata
        if not records.finished:
            left = size - records.at
            self._problem(f"the file was not finished or is cut off: it can be read up to byte {records.at}, {left} bytes follow")

    def _chunk(self, content: bytes) -> None:
        chunk = Chunk.read(_stream(content))
        data = decompress(chunk)
        if len(data) != chunk.uncompressed_size:
            raise ValueError(f"{len(data)} bytes where {chunk.uncompressed_size} are declared")
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise ValueError("checksum differs")
        self._records_of_chunk(np.frombuffer(data, np.uint8))

    def _records_of_chunk(self, data: Bytes) -> None:
        if self._found.shape[0] < data.size // RECORD.size + 1:
            self._found = np.empty((data.size // RECORD.size + 1, 4), np.int64)
        count = find_messages(data, self._found)
        if count < 0:
            raise ValueError("its records do not fit its size")
        found = self._found[:count]
        for opcode, _, start, length in found[found[:, 0] != Opcode.MESSAGE].tolist():
            handler = {Opcode.SCHEMA: self._schema, Opcode.CHANNEL: self._channel}.get(opcode)
            if handler is not None:
                handler(data[start : start + length].tobytes(), sure=True)
        messages = found[found[:, 0] == Opcode.MESSAGE]
        messages[:, 2] += self._waiting_bytes
        self._waiting.append((data, messages))
        self._waiting_bytes += data.size
        if self._waiting_bytes >= _SORT_BYTES:
            self._sort_waiting()

    def _sort_waiting(self) -> None:
        """Keep the messages of several chunks at once: numpy's cost per call is shared."""
        if self._waiting:
            chunks, found = zip(*self._waiting, strict=True)
            self._waiting, self._waiting_bytes = [], 0
            self._keep(np.concatenate(chunks), np.concatenate(found))

    def _keep(self, data: Bytes, found: NDArray[np.int64]) -> None:
        """Copy messages as rows, one block per channel and length."""
        for channel_id in np.flatnonzero(np.bincount(found[:, 1])).tolist():
            of_channel = found[found[:, 1] == channel_id]
            lengths = of_channel[:, 3]
            if (lengths == lengths[0]).all():
                self._keep_rows(data, channel_id, of_channel[:, 2], int(lengths[0]))
                continue
            for start, length in zip(of_channel[:, 2], lengths.tolist(), strict=True):
                self._keep_rows(data, channel_id, np.array([start]), length)

    def _keep_rows(self, data: Bytes, channel_id: int, starts: NDArray[np.int64], length: int) -> None:
        size = length - _MESSAGE_HEAD
        rows = np.zeros((len(starts), 0), np.uint8)
        if size:
            # Every place of the chunk seen as a payload of this size (no copy), of which the starts are taken in one copy.
            every = np.ndarray((data.size - length + 1,), f"V{size}", data, _MESSAGE_HEAD, (1,))
            rows = every[starts].view(np.uint8).reshape(len(starts), size)
        self.rows.setdefault(channel_id, []).append(rows)

    def _message(self, content: bytes) -> None:
        """A message outside any chunk."""
        self._sort_waiting()
        (channel_id,) = struct.unpack_from("<H", content)
        data = np.frombuffer(content, np.uint8)
        if data.size < _MESSAGE_HEAD:
            raise ValueError("too short")
        self._keep_rows(data, channel_id, np.array([0]), data.size)

    def _schema(self, content: bytes, *, sure: bool = False) -> None:
        """One that stands in a chunk with a good checksum is `sure`, and taken before those outside."""
        schema = Schema.read(_stream(content))
        if sure or schema.id not in self.schemas:
            self.schemas[schema.id] = schema

    def _channel(self, content: bytes, *, sure: bool = False) -> None:
        channel = Channel.read(_stream(content))
        if sure or channel.id not in self.topics:
            self.topics[channel.id] = channel

    def _attachment(self, content: bytes) -> None:
        attachment = read_attachment(content)
        self.log.attachments[attachment.name] = attachment.data

    def _metadata(self, content: bytes) -> None:
        metadata = Metadata.read(_stream(content))
        self.log.metadata[metadata.name] = metadata.metadata
        if metadata.name == METADATA_NAME:
            self.log.origin = _origin(metadata.metadata)

    def _statistics(self, content: bytes) -> None:
        self.counts = dict(Statistics.read(_stream(content)).channel_message_counts)

    def _resolve(self) -> None:
        """Turn the blocks of each channel id into one array under its name."""
        for channel_id in list(self.rows):
            blocks = self.rows[channel_id]
            n_rows = sum(len(b) for b in blocks)
            try:
                topic, kind = self.topic(channel_id), self.kind(channel_id)
                records, rejected = _as_records(kind, blocks)
                if rejected:
                    self._problem(f"{topic}: {rejected} payloads are no {kind.name}, left out")
                self.file_under(topic, records)
            except DAMAGE as error:
                self._problem(f"{n_rows} messages of channel id {channel_id} left out: {_first_line(error)}")
            blocks.clear()

    def topic(self, channel_id: int) -> str:
        """Of a channel. Raises ValueError when the file does not describe it."""
        if channel_id not in self.topics:
            raise ValueError("the file does not describe this channel")
        return self.topics[channel_id].topic

    def kind(self, channel_id: int) -> MessageType:
        """The message as the file itself defines it, so that logs outlive changes of our definitions. Raises ValueError."""
        schema = self.schemas.get(self.topics[channel_id].schema_id)
        if schema is None or schema.encoding != SCHEMA_ENCODING or not schema.name.startswith(f"{PACKAGE}/msg/"):
            raise ValueError(f"{self.topics[channel_id].topic} has no schema of softloop's")
        name, text = schema.name.rsplit("/", 1)[1], schema.data.decode()
        known = {c.message for c in CHANNELS}
        return message(name) if name in known and message(name).text == text else _parse(name, text)

    def file_under(self, topic: str, records: Records) -> None:
        """Keep a channel's messages under its name. Raises ValueError when the name is none of ours, or is there already."""
        where = split_topic(topic)
        if where is None:
            raise ValueError(f"'{topic}' is no topic of softloop's")
        _, name, frame = where
        if (name in self.log.channels) if frame is None else (frame in self.log.can):
            raise ValueError(f"'{topic}' is in the file twice")
        if frame is None:
            self.log.channels[name] = records
        else:
            self.log.can[frame] = records

    def _check_counts(self) -> None:
        if self.counts is None:
            return
        for channel_id, topic in self.topics.items():
            where = split_topic(topic.topic)
            expected = self.counts.get(channel_id, 0)
            got = 0
            if where is not None:
                got = len(self.log.can.get(where[2], ()) if where[2] else self.log.channels.get(where[1], ()))
            if got != expected:
                self._problem(f"{topic.topic}: {got} of {expected} messages read")


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))


def _first_line(error: BaseException) -> str:
    return (str(error) or type(error).__name__).splitlines()[0][:120]


def _origin(content: dict[str, str]) -> Origin:
    return Origin(content["bench"], int(content["start_wall_ns"]), int(content["start_clock_ns"]))


def _parse(name: str, text: str) -> MessageType:
    try:
        return MessageType(name, text)
    except Exception as error:  # noqa: BLE001 - the parser raises what it likes on a damaged definition
        raise ValueError(f"the definition of {name} in the file cannot be read: {_first_line(error)}") from None


def _as_records(kind: MessageType, blocks: list[Bytes]) -> tuple[Records, int]:
    """Blocks of payloads as one array of `kind.dtype`, and how many payloads were not of its size or encoding."""
    header = np.frombuffer(CDR_HEADER, "<u4")[0]
    good = [b for b in blocks if b.shape[1] == kind.size]
    total = sum(len(b) for b in blocks)
    records = np.zeros(sum(len(b) for b in good), kind.dtype)
    rows = records.view(np.uint8).reshape(len(records), kind.dtype.itemsize) if len(records) else np.zeros((0, 0), np.uint8)
    at = 0
    for block in good:
        headers = np.ascontiguousarray(block[:, :4]).view("<u4")[:, 0]
        fitting = block if (headers == header).all() else block[headers == header]
        rows[at : at + len(fitting), : kind.cdr_size] = fitting[:, 4:]
        at += len(fitting)
    return records[:at], total - at
