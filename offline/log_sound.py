"""Reading a log that is sound from its first byte to its last: each message is copied once, from its chunk into its array.

What is not sound in any way, or not of the regular form that the recorder writes, is left to the reader of `log`, which trusts
nothing; the result for a sound file is the same.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Chunk
from numba import types
from numpy.typing import NDArray

from softloop.offline.mcap_walk import decompress
from softloop.wire.kernel import array_of, kernel
from softloop.wire.mcap_chunks import MAGIC
from softloop.wire.mcap_layout import CUT_OFF_NAME
from softloop.wire.messages import CDR_HEADER

if TYPE_CHECKING:
    from softloop.offline.log import Log, LogReader
    from softloop.wire.messages import MessageType

Bytes = NDArray[np.uint8]
READ_ONLY = types.Array(types.u1, 1, "C", readonly=True)

_CHUNK = struct.Struct("<QQQII")  # start, end, uncompressed size, crc, length of the compression's name
_MARK_AT = 37  # a chunk's record begins so many bytes before the length of its compression's name
_RATIO_MAX = 300  # more than that no compression of a chunk gives
_ID_MAX = 1024  # channel numbers beyond are none that a recorder gives
_MESSAGE, _ATTACHMENT, _CHUNK_RECORD = int(Opcode.MESSAGE), int(Opcode.ATTACHMENT), int(Opcode.CHUNK)
_SILENT = np.zeros(256, np.bool_)  # records that say nothing which a reader of whole files does not find by itself
_SILENT[[Opcode.HEADER, Opcode.FOOTER, Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX]] = True
_SILENT[[Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET, Opcode.DATA_END]] = True
_NEXT, _ROW, _TAKEN, _LEFT = range(4)  # of a channel: offset of its next row, bytes of a row, bytes of a message, rows to come


class NotSoundError(Exception):
    """The other reader has to read this file."""


@kernel(types.i8(READ_ONLY, types.i8))
def length_at(data: Bytes, at: int) -> int:
    """The 64-bit number at `at`; -1 when it is more than there are bytes, or not all there."""
    if at + 8 > data.size:
        return -1
    length = 0
    for k in range(7, -1, -1):
        length = length * 256 + int(data[at + k])
        if length > data.size:
            return -1
    return length


@kernel(types.b1(READ_ONLY, types.i8, types.i8))
def may_hide_chunk(data: Bytes, start: int, end: int) -> bool:
    """Whether a chunk's record may begin in [start, end), known by the name of its compression and by its two lengths."""
    for head in range(start, min(end, data.size - _MARK_AT - 16)):
        at = head + _MARK_AT
        if data[head] != _CHUNK_RECORD or data[at + 1] != 0 or data[at + 2] != 0 or data[at + 3] != 0:
            continue
        lz4 = data[at] == 3 and data[at + 4] == 108 and data[at + 5] == 122 and data[at + 6] == 52
        zstd = data[at] == 4 and data[at + 4] == 122 and data[at + 5] == 115 and data[at + 6] == 116 and data[at + 7] == 100
        if lz4 or zstd:
            records = length_at(data, at + 4 + int(data[at]))
            if records >= 0 and length_at(data, head + 1) == _MARK_AT + 3 + int(data[at]) + records:
                return True
    return False


@kernel(types.i8(READ_ONLY, types.Array(types.b1, 1, "C"), array_of(types.i8, 2), types.i8))
def walk_file(data: Bytes, silent: NDArray[np.bool_], rows: NDArray[np.int64], end: int) -> int:
    """Rows (opcode, offset of the content, its length) of the records in [8, end), silent ones left out.

    Returns their number, which may be more than there are rows; -1 when the records do not end at `end`, or when one of them may
    hide a chunk: then its length is wrong.
    """
    at, n = 8, 0
    while at < end:
        if at + 9 > end:
            return -1
        length = length_at(data, at + 1)
        after = at + 9 + length
        if length < 0 or after > end or data[at] == 0:
            return -1
        if data[at] != _CHUNK_RECORD and data[at] != _ATTACHMENT and may_hide_chunk(data, at + 1, after):
            return -1
        if not silent[data[at]]:
            if n < rows.shape[0]:
                rows[n, 0], rows[n, 1], rows[n, 2] = data[at], at + 9, length
            n += 1
        at = after
    return n


@kernel(types.void(READ_ONLY, types.i8, array_of(types.u1), types.i8, types.i8))
def copy(data: Bytes, start: int, out: Bytes, to: int, size: int) -> None:
    """`out[to : to + size] = data[start : start + size]`, ten times as fast for places that cannot count from the end."""
    begin, place = np.uint64(start), np.uint64(to)
    for k in range(np.uint64(size)):
        out[place + np.uint64(k)] = data[begin + np.uint64(k)]


@kernel(types.i8(READ_ONLY, array_of(types.i8, 2), array_of(types.u1), array_of(types.i8, 2)))
def take_messages(data: Bytes, channels: NDArray[np.int64], out: Bytes, others: NDArray[np.int64]) -> int:
    """Copy the messages of an uncompressed chunk to their rows in `out`, and list its other records (opcode, offset, length).

    Args:
        data: the records.
        channels: (ids, 4), for each its next row in `out`, the bytes of a row, those of a message, and how many are to come.

    Returns:
        How many others there are; -1 when something is not as it is declared.
    """
    at, n = 0, 0
    while at < data.size:
        if at + 9 > data.size:
            return -1
        length, start = length_at(data, at + 1), at + 9
        if length < 0 or start + length > data.size:
            return -1
        if data[at] == _MESSAGE:
            if length < 26:
                return -1
            number = int(data[start]) + 256 * int(data[start + 1])
            if number >= channels.shape[0] or channels[number, 3] <= 0 or channels[number, 2] != length - 26:
                return -1
            head = start + 22
            if data[head] != 0 or data[head + 1] != 1 or data[head + 2] != 0 or data[head + 3] != 0:
                return -1
            copy(data, head + 4, out, channels[number, 0], length - 26)
            channels[number, 0] += channels[number, 1]
            channels[number, 3] -= 1
        else:
            if n >= others.shape[0]:
                return -1
            others[n, 0], others[n, 1], others[n, 2] = data[at], start, length
            n += 1
        at = start + length
    return n


def read_sound(reader: LogReader, content: Bytes) -> Log:
    """Read a whole file into a fresh reader's log. Raises NotSoundError, and what its parsers raise, where that cannot be."""
    rows = _records(content)
    chunks = rows[:, 0] == _CHUNK_RECORD
    view = memoryview(content)  # type: ignore[arg-type]
    for opcode, start, length in rows[~chunks].tolist():
        reader.handle(opcode, bytes(view[start : start + length]))
    if reader.counts is None:
        raise NotSoundError
    described = reader.described()
    channels, out, arrays = _places(reader, _RATIO_MAX * content.size)
    others = np.empty((256, 3), np.int64)
    for start, length in rows[chunks, 1:].tolist():
        data = _records_of(view[start : start + length])
        found = take_messages(np.frombuffer(data, np.uint8), channels, out, others)
        if found < 0:
            raise NotSoundError
        for opcode, at, size in others[:found].tolist():
            reader.handle(opcode, data[at : at + size], sure=True)
    if channels[:, _LEFT].any() or reader.described() != described:
        raise NotSoundError
    for topic, records in arrays:
        reader.file_under(topic, records)
    reader.log.finished = CUT_OFF_NAME not in reader.log.metadata
    return reader.log


def _records(content: Bytes) -> NDArray[np.int64]:
    end = content.size - len(MAGIC)
    if end < len(MAGIC) or bytes(content[end:]) != MAGIC:
        raise NotSoundError
    rows = np.empty((4096, 3), np.int64)
    found = walk_file(content, _SILENT, rows, end)
    if found > len(rows):
        rows = np.empty((found, 3), np.int64)
        found = walk_file(content, _SILENT, rows, end)
    if found < 0:
        raise NotSoundError
    return rows[:found]


def _places(reader: LogReader, size_max: int) -> tuple[NDArray[np.int64], Bytes, list[tuple[str, NDArray[Any]]]]:
    """Where each channel's messages go, in one buffer: by number; the buffer; and the arrays that it is made of, by topic."""
    counts = {number: count for number, count in (reader.counts or {}).items() if count}
    kinds = {number: reader.kind(number) for number in counts}
    if max(counts, default=0) >= _ID_MAX:
        raise NotSoundError
    channels = np.zeros((_ID_MAX, 4), np.int64)
    size = sum(_rounded(kinds[number].dtype.itemsize * count) for number, count in counts.items())
    if size > size_max:
        raise NotSoundError
    out = np.zeros(size, np.uint8)
    return channels, out, list(_cut(reader, counts, kinds, channels, out))


def _cut(
    reader: LogReader, counts: dict[int, int], kinds: dict[int, MessageType], channels: NDArray[np.int64], out: Bytes
) -> Iterator[tuple[str, NDArray[Any]]]:
    at = 0
    for number, count in counts.items():
        kind = kinds[number]
        channels[number] = at, kind.dtype.itemsize, kind.size - len(CDR_HEADER), count
        yield reader.topic(number), out[at : at + kind.dtype.itemsize * count].view(kind.dtype)
        at += _rounded(kind.dtype.itemsize * count)


def _rounded(size: int) -> int:
    """So that each array begins where its numbers may stand."""
    return -(-size // 64) * 64


def _records_of(content: memoryview) -> bytes:
    first, last, size, crc, name_length = _CHUNK.unpack_from(content)
    at = _CHUNK.size + name_length
    name = bytes(content[_CHUNK.size : at]).decode()
    (length,) = struct.unpack_from("<Q", content, at)
    records = content[at + 8 :]
    if len(records) != length:
        raise NotSoundError
    data = decompress(Chunk(name, records, last, first, crc, size))  # type: ignore[arg-type]
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        raise NotSoundError
    return bytes(data)
