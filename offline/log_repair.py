"""Writing a good file from a damaged one: all that can still be read, in its order, with indexes and summary made anew."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Header, Metadata, Schema

from softloop.offline.log import DAMAGE, find_messages
from softloop.offline.mcap_walk import RECORD, FileRecords, decompress, holds_chunk_mark, read_attachment
from softloop.wire.errors import BadFile, Unavailable
from softloop.wire.log_parts import parts_of
from softloop.wire.mcap_chunks import MAGIC, ChunkedWriter
from softloop.wire.mcap_layout import CHUNK_BYTES, CUT_OFF_NAME, LIBRARY, PROFILE

KEPT_AS = ".damaged"
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel id, sequence, log time, publish time


@dataclass
class Repaired:
    """What a repair wrote, and what it had to leave out."""

    file: Path
    messages: int = 0
    attachments: int = 0
    left_out: int = 0


def repair_log(source: Path, target: Path | None = None) -> Repaired:
    """Write what can be read of `source`, and of the parts after it, into one whole file.

    Args:
        source: the log, or its first part.
        target: where to; None: in place of `source`; it and its parts are then kept beside it with `.damaged` at their ends.

    Raises:
        BadFile: `source` is no MCAP file, or cannot be read; of several parts: none is.
        Unavailable: `target` is there already, or cannot be written.
    """
    parts = parts_of(source)
    kept = [part.with_name(part.name + KEPT_AS) for part in parts]
    taken = next((file for file in (kept if target is None else [target]) if file.exists()), None)
    if taken is not None:
        raise Unavailable(f"{taken}: is there already; move it away first")
    made = (source if target is None else target).with_name((target or source).name + ".partial")
    contents = _read_all(parts)
    try:
        with made.open("wb") as stream:
            found = _rewrite(contents, stream, target or source)
            stream.flush()
            os.fsync(stream.fileno())
        for part, name in zip(parts, kept if target is None else [], strict=False):
            part.rename(name)
        made.rename(target or source)
    except OSError as error:
        with suppress(OSError):
            made.unlink()
        raise Unavailable(f"{made}: cannot be written: {error.strerror or error}") from None
    return found


def _read_all(parts: list[Path]) -> list[memoryview | None]:
    """The parts; None for one that cannot be read. Raises BadFile when none can."""
    contents: list[memoryview | None] = []
    unread = []
    for part in parts:
        try:
            contents.append(_read(part))
        except BadFile as error:  # a recorder that was killed in its first moment
            contents.append(None)
            unread.append(error)
    if len(unread) == len(parts):
        raise unread[0]
    return contents


def _read(source: Path) -> memoryview:
    try:
        with source.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise BadFile(f"{source}: not an MCAP file")
        mapped: Any = np.memmap(source, np.uint8, "r")
    except OSError as error:
        raise BadFile(f"{source}: cannot be read: {error.strerror or error}") from None
    return memoryview(mapped)


def _rewrite(contents: list[memoryview | None], stream: Any, file: Path) -> Repaired:
    rewriter: _Rewriter | None = None
    found, ended = Repaired(file), False
    for content in contents:
        if content is None:
            found.left_out, ended = found.left_out + 1, False
            continue
        described = _Descriptions()
        _each(content, described.handlers)
        if rewriter is None:
            rewriter = _Rewriter(stream, found, described.header)
        rewriter.take_descriptions(described)
        damaged, ended = _each(content, rewriter.handlers)
        found.left_out += damaged + len(rewriter.lost_channels)
    if rewriter is not None:
        rewriter.finish(ended=ended)
    return found


def _each(content: memoryview, handlers: dict[int, Callable[[bytes], None]]) -> tuple[int, bool]:
    """Give every record that has a handler to it; how many places are damaged, and whether the file has an end."""
    records, damaged = FileRecords(content), 0
    for opcode, _, body in records:
        handler = handlers.get(opcode)
        if handler is None:
            continue
        try:
            handler(bytes(body))
        except DAMAGE:
            damaged += 1
            records.damaged()
    return damaged + len(records.skipped), records.finished


class _Descriptions:
    """Header, schemas and channels of a file; those in a chunk, which has a checksum, before those outside."""

    def __init__(self) -> None:
        self.header = Header(PROFILE, LIBRARY)
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.handlers: dict[int, Callable[[bytes], None]] = {
            Opcode.HEADER: self._header,
            Opcode.SCHEMA: self._schema,
            Opcode.CHANNEL: self._channel,
            Opcode.CHUNK: self._chunk,
            Opcode.ATTACHMENT: self._attachment,
        }

    def _attachment(self, body: bytes) -> None:
        """Behind a damaged one the walk goes on as in the second reading, or the channels in it would be described nowhere."""
        read_attachment(body)

    def _header(self, body: bytes) -> None:
        self.header = Header.read(_words(body))

    def _schema(self, body: bytes) -> None:
        schema = Schema.read(_words(body))
        self.schemas.setdefault(schema.id, schema)

    def _channel(self, body: bytes) -> None:
        channel = Channel.read(_words(body))
        self.channels.setdefault(channel.id, channel)

    def _chunk(self, body: bytes) -> None:
        for opcode, content in _records_of_chunk(body):
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(_words(content))
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(_words(content))
                self.channels[channel.id] = channel


class _Rewriter:
    """The state of one repair. Numbers of schemas and channels are given anew, equal ones of several parts the same."""

    def __init__(self, stream: Any, found: Repaired, header: Header) -> None:
        self.found = found
        self.lost_channels: set[int] = set()
        self.writer = ChunkedWriter(stream, header.profile, header.library, CHUNK_BYTES)
        self._attached: set[str] = set()
        self._described: set[str] = set()
        self._channels: dict[int, int] = {}
        self._schema_numbers: dict[tuple[str, str, bytes], int] = {}
        self._channel_numbers: dict[tuple[str, str, int], int] = {}
        self.handlers: dict[int, Callable[[bytes], None]] = {
            Opcode.CHUNK: self._chunk,
            Opcode.MESSAGE: self._message,
            Opcode.ATTACHMENT: self._attachment,
            Opcode.METADATA: self._metadata,
        }

    def take_descriptions(self, described: _Descriptions) -> None:
        """Begin the next part: what its numbers of schemas and channels mean."""
        self.lost_channels = set()
        schemas = {0: 0} | {number: self._schema_number(schema) for number, schema in described.schemas.items()}
        self._channels = {
            number: self._channel_number(channel, schemas[channel.schema_id])
            for number, channel in described.channels.items()
            if channel.schema_id in schemas
        }

    def _schema_number(self, schema: Schema) -> int:
        key = (schema.name, schema.encoding, bytes(schema.data))
        if key not in self._schema_numbers:
            self._schema_numbers[key] = self.writer.add_schema(schema.name, schema.encoding, schema.data)
        return self._schema_numbers[key]

    def _channel_number(self, channel: Channel, schema: int) -> int:
        key = (channel.topic, channel.message_encoding, schema)
        if key not in self._channel_numbers:
            self._channel_numbers[key] = self.writer.add_channel(channel.topic, channel.message_encoding, schema)
        return self._channel_numbers[key]

    def _attachment(self, body: bytes) -> None:
        attachment = read_attachment(body)
        if attachment.name not in self._attached:
            self._attached.add(attachment.name)
            self.writer.add_attachment(attachment.log_time, attachment.name, attachment.media_type, attachment.data)
            self.found.attachments += 1

    def _metadata(self, body: bytes) -> None:
        metadata = Metadata.read(_words(body))
        if metadata.name not in self._described:
            self._described.add(metadata.name)
            self.writer.add_metadata(metadata.name, metadata.metadata)

    def finish(self, *, ended: bool) -> None:
        """Write index and summary; where the recorder did not end the log, that too, for nothing else would show it any more."""
        if not ended and CUT_OFF_NAME not in self._described:
            self.writer.add_metadata(CUT_OFF_NAME, {})
        self.writer.finish()

    def _message(self, body: bytes) -> None:
        channel_id, sequence, log_time, _ = _MESSAGE_HEAD.unpack_from(body)
        ours = self._channels.get(channel_id)
        if ours is None:
            self.lost_channels.add(channel_id)
            return
        self.writer.add_message(ours, log_time, sequence, body[_MESSAGE_HEAD.size :])
        self.found.messages += 1

    def _chunk(self, body: bytes) -> None:
        for opcode, content in _records_of_chunk(body):
            if opcode == Opcode.MESSAGE:
                self._message(content)


def _records_of_chunk(body: bytes) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of each record of a chunk, once all of it is known to be sound. Raises one of DAMAGE."""
    chunk = Chunk.read(_stream(body))
    data = decompress(chunk)
    if len(data) != chunk.uncompressed_size or (chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc):
        raise ValueError("checksum differs")
    found = np.empty((len(data) // RECORD.size + 1, 4), np.int64)
    count = find_messages(np.frombuffer(data, np.uint8), found)
    if count < 0:
        raise ValueError("its records do not fit its size")
    for opcode, _, start, length in found[:count].tolist():
        yield opcode, data[start : start + length]


def _words(body: bytes) -> ReadDataStream:
    """A description, which goes into the new file as it is. Raises ValueError when a reader would take part of it for a chunk."""
    if holds_chunk_mark(body):
        raise ValueError("a chunk begins in it")
    return _stream(body)


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))
