"""The records of an MCAP file, one after the other, also of a damaged one: behind damage it goes on at the next sound chunk."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Chunk

from softloop.wire.mcap_chunks import MAGIC

RECORD = struct.Struct("<BQ")  # opcode and length before every record
_CHUNK_HEAD = struct.Struct("<BQQQQII")  # opcode, length, start, end, uncompressed size, crc, length of the compression's name
_COMPRESSIONS = (b"lz4", b"zstd")
_LZ4_RATIO_MAX = 260  # LZ4 cannot expand more than 255 times; zstd's window is bounded by _CHUNK_MAX alone
_CHUNK_MAX = 1 << 30


class FileRecords:
    """Iterates over (opcode, offset, content) of the records in `view`, the bytes of a whole file.

    Attributes:
        at: how far it came.
        finished: the end mark was there.
        skipped: (from, to) of bytes that belong to no record that could be found.
    """

    def __init__(self, view: memoryview) -> None:
        self._view = view
        self._record_at = 0
        self.at = len(MAGIC)
        self.finished = False
        self.skipped: list[tuple[int, int]] = []

    def __iter__(self) -> Iterator[tuple[int, int, memoryview]]:
        view = self._view
        while self.at < len(view):
            if len(view) - self.at == len(MAGIC) and view[self.at :] == MAGIC:
                self.finished = True
                return
            length = self._length()
            if length < 0:
                if not self._resume():
                    return
                continue
            opcode, start = view[self.at], self.at + RECORD.size
            self._record_at, self.at = self.at, start + length
            yield opcode, self._record_at, view[start : self.at]
            if opcode != Opcode.ATTACHMENT:
                self.damaged()

    def _length(self) -> int:
        """Of the record at `at`; -1 when there can be none."""
        if self.at + RECORD.size > len(self._view):
            return -1
        opcode, length = RECORD.unpack_from(self._view, self.at)
        fits = self.at + RECORD.size + length <= len(self._view)
        return int(length) if fits and opcode else -1

    def _resume(self) -> bool:
        found = next_chunk(self._view, self.at + 1)
        if found < 0:
            return False
        self.skipped.append((self.at, found))
        self.at = found
        return True

    def damaged(self) -> None:
        """Where a chunk begins inside the record that came last, that record's length is wrong, and the chunk comes next.

        Called for every record but attachments, which may hold anything; of those, the caller says which one is damaged. Who does
        not, misses all that stands in one with a wrong length: whoever walks a file has to read its attachments.
        """
        found = next_chunk(self._view, self._record_at + 1, self.at)
        if found >= 0:
            self.at = found


def read_attachment(body: bytes) -> Attachment:
    """An attachment whose checksum, where it has one, is right. Raises ValueError, or what its parser raises on damage."""
    attachment = Attachment.read(ReadDataStream(BytesIO(body)))
    (crc,) = struct.unpack("<I", body[-4:])
    if crc and zlib.crc32(body[:-4]) != crc:
        raise ValueError("checksum differs")
    return attachment


def holds_chunk_mark(data: bytes) -> bool:
    """Whether there is what a chunk is known by. In a description it is damage: a walk would look for a chunk there."""
    return any(struct.pack("<I", len(name)) + name in data for name in _COMPRESSIONS)


def next_chunk(view: memoryview, start: int, end: int | None = None) -> int:
    """Offset of the first chunk record that begins in [start, end), known by its header; -1 when there is none."""
    end = len(view) if end is None else end
    data = bytes(view[start : end + _CHUNK_HEAD.size + 4])
    best = -1
    for name in _COMPRESSIONS:
        mark = struct.pack("<I", len(name)) + name
        at = data.find(mark, _CHUNK_HEAD.size - 4)
        while at >= 0:
            head = start + at - (_CHUNK_HEAD.size - 4)
            if head >= end or (0 <= best <= head):
                break
            if _is_chunk(view, head, len(name)):
                best = head
                break
            at = data.find(mark, at + 1)
    return best


def _is_chunk(view: memoryview, at: int, name_length: int) -> bool:
    opcode, length, first, last, size, _, _ = _CHUNK_HEAD.unpack_from(view, at)
    body = at + _CHUNK_HEAD.size + name_length
    if opcode != Opcode.CHUNK or body + 8 > len(view) or first > last or size == 0:
        return False
    (records,) = struct.unpack_from("<Q", view, body)
    # What the chunk's length leaves for its records must be what the records' own length says.
    return bool(length == _CHUNK_HEAD.size - RECORD.size + name_length + 8 + records and at + RECORD.size + length <= len(view))


def decompress(chunk: Chunk) -> bytes:
    """The records of a chunk. Raises what its library raises on damage, and ValueError on sizes that cannot be."""
    size = chunk.uncompressed_size
    if size > _CHUNK_MAX:
        raise ValueError(f"{size} bytes declared")
    if chunk.compression == "lz4":
        if size > _LZ4_RATIO_MAX * (len(chunk.data) + 64):
            raise ValueError(f"{size} bytes declared in {len(chunk.data)}")
        return lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size) if size else b""
    if chunk.compression == "zstd":
        return zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    if chunk.compression:
        raise ValueError(f"unknown compression '{chunk.compression[:16]}'")
    return chunk.data
