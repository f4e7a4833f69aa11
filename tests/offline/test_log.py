"""Reading logs: equal values, and never anything but BadFile."""

import io
from pathlib import Path

import numpy as np
import pytest
import synthetic
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from softloop.offline.log import find_messages, open_log
from softloop.wire.errors import BadFile
from softloop.wire.mcap_layout import Origin
from softloop.wire.messages import message

MADE = list(synthetic.messages(0.5))


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    return synthetic.write_log(tmp_path_factory.mktemp("log") / "run.mcap", MADE, chunk_bytes=8 * 1024)


@pytest.fixture(scope="module")
def whole(small):
    return open_log(small)


def expected(name):
    return [value for channel, _, value in MADE if channel == name]


def test_every_message_is_there_with_its_values(whole):
    assert whole.problems == []
    for name in ("pressure", "inclination", "command", "valves", "truth", "cycle", "status", "request", "event"):
        kind = message(synthetic.BY_NAME[name].message)
        assert [kind.pack_record(r) for r in whole[name]] == [kind.pack(v) for v in expected(name)], name
    frames = whole.can["can0", 0x80]
    assert frames["seq"].tolist() == [v.seq for v in expected("can")]
    assert frames["data"].tolist() == [[1] * 8] * len(frames)


def test_fields_by_name(whole):
    assert whole["cycle"]["error_deg"].tolist() == [v.error_deg for v in expected("cycle")]
    assert whole["cycle"]["theta"].shape == (len(expected("cycle")), 14)


def test_what_stands_beside_the_messages(whole):
    assert whole.origin == Origin("synthetic", synthetic.START_WALL_NS, synthetic.START_CLOCK_NS)
    assert whole.text("bench.toml") == synthetic.BENCH_TOML.decode()
    assert whole.table("git.json") == {"commit": "abc", "dirty": False}
    assert whole.table("nothing.json") == {}


def test_an_unknown_channel_is_named_with_the_known_ones(whole):
    with pytest.raises(BadFile, match=r"no channel 'speed' .*pressure.*truth"):
        whole["speed"]


def test_a_channel_without_messages_is_empty(tmp_path):
    log = open_log(synthetic.write_log(tmp_path / "run.mcap", []))
    assert log.problems == []
    assert len(log["cycle"]) == 0
    assert log["cycle"]["error_deg"].shape == (0,)


def test_an_unfinished_file_gives_all_its_chunks(tmp_path):
    log = open_log(synthetic.write_log(tmp_path / "run.mcap", MADE, finish=False))
    assert len(log["cycle"]) == len(expected("cycle"))
    assert len(log.problems) == 1
    assert "not finished" in log.problems[0]


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r", b"hello, this is text", b"\x89MCAP1\r\n" + bytes(100)])
def test_what_is_no_mcap_is_said(tmp_path, content):
    file = tmp_path / "run.mcap"
    file.write_bytes(content)
    with pytest.raises(BadFile, match=r"run\.mcap: not an MCAP file"):
        open_log(file)


def test_a_missing_file_and_a_folder(tmp_path):
    with pytest.raises(BadFile, match="cannot be read"):
        open_log(tmp_path / "none.mcap")
    with pytest.raises(BadFile, match="cannot be read"):
        open_log(tmp_path)


def assert_all_before(log, whole):
    """What was read is what the file held: all messages of the chunks that are whole, in order, none invented."""
    for name in whole.channels:
        seen = {r.tobytes() for r in whole[name]}
        assert all(r.tobytes() in seen for r in log[name])
        assert np.all(np.diff(log[name]["seq"].astype(np.int64)) > 0) or name == "event"


QUICK = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@QUICK
@given(st.floats(0, 1))
def test_cut_anywhere(small, whole, tmp_path, where):
    content = small.read_bytes()
    cut = min(int(where * len(content)), len(content) - 1)
    file = tmp_path / "cut.mcap"
    file.write_bytes(content[:cut])
    if cut < 8:
        with pytest.raises(BadFile):
            open_log(file)
        return
    log = open_log(file)
    assert log.problems
    for name in whole.channels:
        n = len(log[name])
        assert log[name].tobytes() == whole[name][:n].tobytes()


@QUICK
@given(st.floats(0, 1), st.integers(1, 255))
def test_flip_anywhere(small, whole, tmp_path, where, bits):
    content = bytearray(small.read_bytes())
    at = min(int(where * len(content)), len(content) - 1)
    content[at] ^= bits
    file = tmp_path / "flip.mcap"
    file.write_bytes(content)
    try:
        log = open_log(file)
    except BadFile:
        assert at < 8
        return
    assert_all_before(log, whole)
    lost = sum(len(whole[n]) - len(log[n]) for n in whole.channels)
    assert lost == 0 or log.problems
    if lost == 0 and not log.problems:
        assert log.can.keys() == whole.can.keys()


@QUICK
@given(st.binary(max_size=400))
def test_anything_after_the_magic(tmp_path, tail):
    file = tmp_path / "any.mcap"
    file.write_bytes(b"\x89MCAP0\r\n" + tail)
    open_log(file)


@pytest.mark.parametrize("step", [37, pytest.param(1, marks=pytest.mark.long)])
def test_the_bytes_of_the_first_records_flipped(tmp_path, step):
    """Header, attachments and metadata: too short a part of the file for random places to hit each field."""
    whole = open_log(synthetic.write_log(tmp_path / "tiny.mcap", list(synthetic.messages(0.02))))
    content = (tmp_path / "tiny.mcap").read_bytes()
    file = tmp_path / "flip.mcap"
    for at in range(8, content.index(b"lz4") + 8, step):
        file.write_bytes(content[:at] + bytes([content[at] ^ 0x81]) + content[at + 1 :])
        assert_all_before(open_log(file), whole)


def test_a_damaged_chunk_costs_that_chunk_only(small, whole, tmp_path):
    content = bytearray(small.read_bytes())
    second = content.index(b"lz4", content.index(b"lz4") + 3)
    content[second + 200] ^= 0xFF
    file = tmp_path / "hole.mcap"
    file.write_bytes(content)
    log = open_log(file)
    assert 0 < len(log["cycle"]) < len(whole["cycle"])
    assert log["cycle"]["seq"][-1] == whole["cycle"]["seq"][-1]
    assert any("damaged chunk" in p for p in log.problems)
    assert any("/softloop/synthetic/cycle" in p for p in log.problems)


def copy_with(tmp_path, compression, use_chunking=True, resize=False):
    """The same messages as another tool would write them."""
    stream = io.BytesIO()
    writer = Writer(stream, compression=compression, use_chunking=use_chunking)
    writer.start("ros2")
    ids = {}
    for name, key, value in MADE:
        kind = message(synthetic.BY_NAME[name].message)
        if key not in ids:
            schema = writer.register_schema(kind.ros_name, "ros2msg", kind.text.encode())
            ids[key] = writer.register_channel(f"/{key}", "cdr", schema)
        data = kind.pack(value)
        writer.add_message(ids[key], 1, data[:-1] if resize and value.seq % 3 == 0 else data, 1)
    writer.finish()
    file = tmp_path / "other.mcap"
    file.write_bytes(stream.getvalue())
    return file


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("compression", list(CompressionType))
def test_files_of_other_writers(tmp_path, whole, compression, chunked):
    log = open_log(copy_with(tmp_path, compression, chunked))
    assert log.problems == []
    assert log.origin is None
    assert log["cycle"].tobytes() == whole["cycle"].tobytes()


def test_payloads_of_a_wrong_size_are_left_out_and_counted(tmp_path):
    log = open_log(copy_with(tmp_path, CompressionType.LZ4, resize=True))
    assert (log["cycle"]["seq"] % 3 != 0).all()
    assert any("/cycle: 33 payloads are no CycleRecord" in p for p in log.problems)


def test_an_older_definition_is_read_as_the_file_has_it(tmp_path):
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start("ros2")
    schema = writer.register_schema(
        "softloop_msgs/msg/CycleRecord", "ros2msg", b"uint64 seq\nint64 stamp_ns\nfloat32 old_field\n"
    )
    channel = writer.register_channel("/softloop/x/cycle", "cdr", schema)
    for k in range(3):
        data = (
            b"\0\1\0\0" + np.array([k], "<u8").tobytes() + np.array([5 * k], "<i8").tobytes() + np.array([k / 2], "<f4").tobytes()
        )
        writer.add_message(channel, k, data, k)
    writer.finish()
    file = tmp_path / "old.mcap"
    file.write_bytes(stream.getvalue())
    assert open_log(file)["cycle"]["old_field"].tolist() == [0.0, 0.5, 1.0]


def test_topics_and_schemas_of_others_are_left_out(tmp_path):
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    schema = writer.register_schema("other/msg/X", "ros2msg", b"uint64 seq\n")
    writer.add_message(writer.register_channel("/softloop/x/cycle", "cdr", schema), 1, b"12345678", 1)
    writer.add_message(writer.register_channel("/tf", "cdr", 0), 1, b"12345678", 1)
    writer.finish()
    file = tmp_path / "foreign.mcap"
    file.write_bytes(stream.getvalue())
    log = open_log(file)
    assert log.channels == {}
    assert sum("left out" in p for p in log.problems) == 2


def test_the_scan_refuses_records_that_do_not_fit():
    found = np.empty((10, 4), np.int64)
    good = bytes([3]) + (5).to_bytes(8, "little") + b"abcde"
    assert find_messages(np.frombuffer(good, np.uint8), found) == 1
    assert find_messages(np.frombuffer(good[:-1], np.uint8), found) == -1
    assert find_messages(np.frombuffer(good + b"\5", np.uint8), found) == -1
    huge = bytes([5]) + b"\xff" * 8 + bytes(30)
    assert find_messages(np.frombuffer(huge, np.uint8), found) == -1
    assert find_messages(np.frombuffer(good * 11, np.uint8), found) == -1
