"""An MCAP file written in chunks, with little Python per message: what the recorder and the repair of a log write with.

The rare records (header, schemas, channels, attachments, indexes, summary) are built by the mcap library. A message is packed at
once into the chunk in progress, and only its time and place are noted, from which the chunk's indexes are made when it closes.
Schemas and channels stand twice, before the chunk of their first message and in it: a damaged chunk takes no channel with it, and
the one in the chunk has a checksum.
"""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Sequence
from typing import Any

import lz4.frame
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"
COMPRESSION = "lz4"
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel id, sequence, log time, publish time
_MESSAGE_HEAD = _MESSAGE.size - 9  # of it what the length counts
_INDEX = struct.Struct("<BQHI")  # opcode, length, channel id, bytes of pairs
_FOOTER = struct.Struct("<BQQQ")


class ChunkedWriter:
    """Writes one MCAP file into a stream with `write` and `tell`. Not thread-safe; errors of the stream pass through."""

    def __init__(self, stream: Any, profile: str, library: str, chunk_bytes: int) -> None:
        self._stream = stream
        self._chunk_bytes = chunk_bytes
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._chunks: list[ChunkIndex] = []
        self._counts: dict[int, int] = {}
        self._records = bytearray()
        self._places: dict[int, array[int]] = {}  # channel id -> log time and offset in the chunk, in turn
        stream.write(MAGIC)
        self._write(Header(profile=profile, library=library))

    def _write(self, record: McapRecord) -> tuple[int, int]:
        """Write a record outside chunks; its offset and length."""
        data, at = _bytes_of(record), self._stream.tell()
        self._stream.write(data)
        return at, len(data)

    def _write_twice(self, record: McapRecord) -> None:
        """Before all messages that need it, and in the next chunk, whose checksum shows damage."""
        self._write(record)
        self._records += _bytes_of(record)

    def add_attachment(self, time_ns: int, name: str, media_type: str, data: bytes) -> None:
        attachment = Attachment(create_time=time_ns, log_time=time_ns, name=name, media_type=media_type, data=data)
        at, length = self._write(attachment)
        self._attachments.append(AttachmentIndex(at, length, time_ns, time_ns, len(data), name, media_type))

    def add_metadata(self, name: str, content: dict[str, str]) -> None:
        at, length = self._write(Metadata(name=name, metadata=content))
        self._metadata.append(MetadataIndex(at, length, name))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Returns the schema's id."""
        self._schemas.append(Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=data))
        self._write_twice(self._schemas[-1])
        return len(self._schemas)

    def add_channel(self, topic: str, message_encoding: str, schema_id: int) -> int:
        """Returns the channel's id."""
        number = len(self._channels) + 1
        self._channels.append(Channel(number, topic, message_encoding, {}, schema_id))
        self._write_twice(self._channels[-1])
        self._counts[number] = 0
        return number

    def add_message(self, channel_id: int, log_time: int, sequence: int, payload: bytes) -> None:
        """Pack a message into the chunk in progress; a chunk that is full is closed. struct.error on too large a number."""
        places = self._places.get(channel_id)
        if places is None:
            places = self._places[channel_id] = array("Q")
        records = self._records
        head = _MESSAGE.pack(Opcode.MESSAGE, _MESSAGE_HEAD + len(payload), channel_id, sequence, log_time, log_time)
        places.append(log_time)
        places.append(len(records))
        records += head
        records += payload
        if len(records) > self._chunk_bytes:
            self.flush()

    def flush(self) -> None:
        """Close the chunk in progress and write it with its message indexes; nothing when it holds no message."""
        if not self._places:
            return
        data, places = bytes(self._records), self._places
        self._records, self._places = bytearray(), {}
        start, end = min(min(p[::2]) for p in places.values()), max(max(p[::2]) for p in places.values())
        packed = lz4.frame.compress(data)
        at, length = self._write(Chunk(COMPRESSION, packed, end, start, zlib.crc32(data), len(data)))
        offsets, index_at = {}, self._stream.tell()
        for channel_id, of_channel in places.items():
            offsets[channel_id] = self._stream.tell()
            pairs = of_channel.tobytes()
            self._stream.write(_INDEX.pack(Opcode.MESSAGE_INDEX, 6 + len(pairs), channel_id, len(pairs)) + pairs)
            self._counts[channel_id] += len(of_channel) // 2
        self._chunks.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=at,
                compression=COMPRESSION,
                compressed_size=len(packed),
                message_end_time=end,
                message_index_length=self._stream.tell() - index_at,
                message_index_offsets=offsets,
                message_start_time=start,
                uncompressed_size=len(data),
            )
        )

    def finish(self) -> None:
        """Write summary and end mark; nothing may be added after."""
        self.flush()
        self._write(DataEnd(0))
        start = self._stream.tell()
        summary = bytearray()
        offsets: list[SummaryOffset] = []
        groups: dict[Opcode, Sequence[McapRecord]] = {
            Opcode.SCHEMA: self._schemas,
            Opcode.CHANNEL: self._channels,
            Opcode.STATISTICS: [self._statistics()],
            Opcode.CHUNK_INDEX: self._chunks,
            Opcode.ATTACHMENT_INDEX: self._attachments,
            Opcode.METADATA_INDEX: self._metadata,
        }
        for code, group in groups.items():
            before = len(summary)
            summary += b"".join(_bytes_of(record) for record in group)
            if len(summary) > before:
                offsets.append(SummaryOffset(code, start + before, len(summary) - before))
        offsets_at = start + len(summary)
        summary += b"".join(_bytes_of(offset) for offset in offsets)
        crc = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, 20, start, offsets_at), zlib.crc32(summary))
        self._stream.write(bytes(summary))
        self._write(Footer(start, offsets_at, crc))
        self._stream.write(MAGIC)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((c.message_end_time for c in self._chunks), default=0),
            message_start_time=min((c.message_start_time for c in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
