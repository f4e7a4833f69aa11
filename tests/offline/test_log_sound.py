"""The reader of sound files gives what the other one gives, and leaves to it what is not sound."""

import random
import struct

import numpy as np
import pytest
import synthetic
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType, Writer

from softloop.offline.log import DAMAGE, LogReader, open_log
from softloop.offline.log_repair import repair_log
from softloop.offline.log_sound import NotSoundError, read_sound
from softloop.offline.mcap_walk import FileRecords
from softloop.wire.mcap_layout import SCHEMA_ENCODING, Origin
from softloop.wire.messages import CDR_HEADER, message

MADE = list(synthetic.messages(0.3))


def sound(content):
    return read_sound(LogReader("x"), np.frombuffer(bytes(content), np.uint8))


def is_taken(content):
    try:
        sound(content)
    except (NotSoundError, *DAMAGE):
        return False
    return True


def same(one, other):
    assert one.problems == other.problems
    assert (one.origin, one.attachments, one.metadata) == (other.origin, other.attachments, other.metadata)
    assert one.finished == other.finished
    for ours, theirs in ((one.channels, other.channels), (one.can, other.can)):
        assert set(ours) == set(theirs)
        for name, records in ours.items():
            assert records.dtype == theirs[name].dtype
            assert records.tobytes() == theirs[name].tobytes(), name
            assert records.flags.aligned
            assert records.flags.writeable


@pytest.fixture
def file(tmp_path):
    return synthetic.write_log(tmp_path / "run.mcap", MADE, chunk_bytes=4096)


@pytest.mark.parametrize("chunk_bytes", [600, 4096, 1 << 20])
def test_a_sound_file_is_read_as_by_the_other_reader(tmp_path, chunk_bytes):
    content = synthetic.write_log(tmp_path / "run.mcap", MADE, chunk_bytes=chunk_bytes).read_bytes()
    same(sound(content), LogReader("x").read(memoryview(content)))
    assert sound(content)["cycle"]["seq"].tolist() == [v.seq for n, _, v in MADE if n == "cycle"]


def test_a_repaired_file_keeps_its_missing_end(tmp_path):
    cut = synthetic.write_log(tmp_path / "cut.mcap", MADE, finish=False)
    assert not is_taken(cut.read_bytes())
    content = repair_log(cut, tmp_path / "good.mcap").file.read_bytes()
    assert not sound(content).finished
    same(sound(content), LogReader("x").read(memoryview(content)))


@pytest.mark.parametrize("seed", range(4))
def test_whatever_is_done_to_a_file_both_give_the_same(tmp_path, file, seed):
    rng, whole, taken = random.Random(seed), file.read_bytes(), 0
    for _ in range(150):
        content = bytearray(whole)
        for _ in range(rng.choice((1, 1, 2, 5))):
            at, kind = rng.randrange(8, len(content)), rng.randrange(4)
            if kind == 0:
                content[at] ^= 1 << rng.randrange(8)
            elif kind == 1:
                content[at : at + rng.randint(0, 30)] = rng.randbytes(rng.randint(0, 30))
            elif kind == 2:
                del content[at:]
            else:
                other = rng.randrange(8, len(whole))
                content[at:at] = whole[other : other + rng.randint(1, 6000)]
        if is_taken(content):
            taken += 1
            same(sound(content), LogReader("x").read(memoryview(bytes(content))))
        (tmp_path / "c.mcap").write_bytes(content)
        same(open_log(tmp_path / "c.mcap"), LogReader("x").read(memoryview(bytes(content))))
    assert taken > 0  # a bit of an index, say, is no harm to either


def written(payloads, counts=None, **options):
    """A log of pressures as the mcap library writes it."""
    from io import BytesIO  # noqa: PLC0415

    stream, kind = BytesIO(), message("PressureSample")
    writer = Writer(stream, **options)
    writer.start("softloop", "test")
    schema = writer.register_schema(kind.ros_name, SCHEMA_ENCODING, kind.text.encode())
    channel = writer.register_channel("/softloop/b/pressure", "cdr", schema)
    writer.add_metadata("softloop", Origin("b", 1, 0).as_metadata())
    for k, payload in enumerate(payloads):
        writer.add_message(channel, k, payload, k)
    writer.finish()
    return stream.getvalue()


def pressure(seq):
    kind = message("PressureSample")
    return kind.pack(kind.make(seq=seq, stamp_ns=seq))


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("index", [IndexType.ALL, IndexType.NONE])
def test_what_others_write_is_taken_too(compression, index):
    content = written([pressure(k) for k in range(300)], compression=compression, chunk_size=1000, index_types=index)
    same(sound(content), LogReader("x").read(memoryview(content)))
    assert len(sound(content).channels["pressure"]) == 300


@pytest.mark.parametrize(
    "odd",
    [pressure(7)[:-1], pressure(7) + b"x", b"", CDR_HEADER, b"\x00\x00\x00\x00" + pressure(7)[4:]],
    ids=["short", "long", "empty", "header alone", "big endian"],
)
def test_a_payload_of_another_form_is_for_the_other_reader(tmp_path, odd):
    content = written([pressure(1), odd, pressure(2)])
    assert not is_taken(content)
    (tmp_path / "c.mcap").write_bytes(content)
    assert open_log(tmp_path / "c.mcap")["pressure"]["seq"].tolist() == [1, 2]


def test_messages_outside_chunks_and_files_without_statistics_are_for_the_other_reader():
    payloads = [pressure(k) for k in range(3)]
    assert is_taken(written(payloads))
    assert not is_taken(written(payloads, use_chunking=False))
    assert not is_taken(written(payloads, use_statistics=False))


def test_statistics_that_lie_are_found(file):
    """More, and fewer, and so many that no memory holds them."""
    content = bytearray(file.read_bytes())
    at, body = next((at, bytes(b)) for op, at, b in FileRecords(memoryview(bytes(content))) if op == Opcode.STATISTICS)
    first = at + 9 + 8 + 2 + 4 + 4 + 4 + 4 + 8 + 8 + 4 + 2  # the count of the first channel
    (count,) = struct.unpack_from("<Q", content, first)
    assert 0 < count < 1000
    assert len(body) > 50
    for lie in (count + 1, count - 1, 0, 1 << 40, (1 << 64) - 1):
        struct.pack_into("<Q", content, first, lie)
        assert not is_taken(content)
    struct.pack_into("<Q", content, first, count)
    assert is_taken(content)


def test_a_chunk_hidden_behind_a_wrong_length_is_for_the_other_reader(tmp_path, file):
    content = file.read_bytes()
    records = [(op, at, len(body)) for op, at, body in FileRecords(memoryview(content))]
    start = next(at for op, at, _ in records if op == Opcode.MESSAGE_INDEX)
    last = max(at + 9 + n for op, at, n in records if op == Opcode.CHUNK)
    hiding = content[:start] + b"\x0f" + struct.pack("<Q", last - start) + content[start:]
    assert not is_taken(hiding)
    (tmp_path / "c.mcap").write_bytes(hiding)
    assert len(open_log(tmp_path / "c.mcap")["cycle"]) > 0.8 * sum(n == "cycle" for n, _, _ in MADE)
