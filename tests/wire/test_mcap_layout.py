"""The layout of a log: what others read in it."""

import io
import json
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from softloop.wire.channels import CAN, COMMAND, EVENT, PRESSURE, can_key, key
from softloop.wire.mcap_layout import (
    BadMessage,
    LogWriter,
    Origin,
    attachments_of,
    git_state,
    known_channel,
    read_origin,
    split_topic,
)
from softloop.wire.messages import message

ORIGIN = Origin("b", 1_000_000_000, 400)


def pressure(**values):
    kind = message("PressureSample")
    return kind.pack(kind.make(**values))


def written(add):
    stream = io.BytesIO()
    writer = LogWriter(stream, ORIGIN, {"bench.toml": b"name = 'b'\n"})
    add(writer)
    writer.finish()
    return make_reader(io.BytesIO(stream.getvalue()))


def test_sequence_and_times_are_the_messages_own():
    reader = written(lambda w: w.add(key("b", PRESSURE), PRESSURE, pressure(seq=7, stamp_ns=500)))
    [(schema, channel, found)] = reader.iter_messages()
    assert (found.sequence, found.log_time, found.publish_time) == (7, 1_000_000_100, 1_000_000_100)
    assert (channel.topic, channel.message_encoding) == ("/softloop/b/pressure", "cdr")
    assert (schema.name, schema.encoding) == ("softloop_msgs/msg/PressureSample", "ros2msg")
    assert schema.data.decode() == message("PressureSample").text
    assert reader.get_header().profile == "ros2"


def test_a_long_sequence_wraps_in_the_file_only():
    payload = pressure(seq=(1 << 32) + 3, stamp_ns=500)
    reader = written(lambda w: w.add(key("b", PRESSURE), PRESSURE, payload))
    [(_, _, found)] = reader.iter_messages()
    assert found.sequence == 3
    assert found.data == payload


@pytest.mark.parametrize(
    "payload", [b"", b"\0\1\0\0", pressure()[:-1], b"\1\1\0\0" + pressure()[4:], pressure(stamp_ns=-(1 << 62))]
)
def test_what_is_not_the_channels_message_is_refused_and_harms_nothing(payload):
    def add(writer):
        with pytest.raises(BadMessage, match="softloop/b/pressure"):
            writer.add(key("b", PRESSURE), PRESSURE, payload)
        writer.add(key("b", PRESSURE), PRESSURE, pressure(seq=1, stamp_ns=500))

    assert len(list(written(add).iter_messages())) == 1


def test_can_frames_have_a_topic_each_and_one_schema():
    kind = message("CanFrame")

    def add(writer):
        for number in (0x80, 0x100, 0x80):
            _, sender = writer.add(can_key("b", "can0", number), CAN, kind.pack(kind.make(node=5, stamp_ns=500)))
            assert sender == 5

    reader = written(add)
    topics = [channel.topic for _, channel, _ in reader.iter_messages()]
    assert topics == ["/softloop/b/can/can0/80", "/softloop/b/can/can0/100", "/softloop/b/can/can0/80"]
    assert sum(s.name.endswith("CanFrame") for s in reader.get_summary().schemas.values()) == 1


def test_attachments_and_metadata_come_before_all_messages():
    stream = io.BytesIO()
    LogWriter(stream, ORIGIN, {"bench.toml": b"name = 'b'\n"})
    assert b"bench.toml" in stream.getvalue()  # nothing was flushed or finished
    assert b"start_clock_ns" in stream.getvalue()


def test_attachments_are_the_files_of_the_run(tmp_path: Path):
    (tmp_path / "rig.dbc").write_bytes(b"VERSION")
    (tmp_path / "other.txt").write_bytes(b"x")
    found = attachments_of(tmp_path)
    assert set(found) == {"rig.dbc", "versions.json", "git.json"}
    versions = json.loads(found["versions.json"])
    assert set(versions) == {"softloop", "python", "numpy", "numba", "zenoh", "kernel", "cpu"}
    assert versions["python"].startswith(f"{sys.version_info.major}.{sys.version_info.minor}")


def test_git_state_without_a_repository(tmp_path: Path):
    assert git_state(tmp_path) == {"commit": None, "dirty": None}


def test_event_senders_are_told_apart():
    kind = message("Event")

    def add(writer):
        assert writer.add(key("b", EVENT), EVENT, kind.pack(kind.make(stamp_ns=500, source=4)))[1] == 4

    written(add)


@pytest.mark.parametrize(
    ("topic", "expected"),
    [
        ("/softloop/b/pressure", ("b", "pressure", None)),
        ("/softloop/b/can/can0/7ff", ("b", "can", ("can0", 0x7FF))),
        ("/softloop/b/can/can0/7FF", None),
        ("/softloop/b/can/can0/zz", None),
        ("/softloop/b/can/80", None),
        ("/softloop/b/pressure/x", None),
        ("softloop/b/pressure", None),
        ("/other/b/pressure", None),
    ],
)
def test_topics(topic, expected):
    assert split_topic(topic) == expected


def test_only_the_benchs_own_channels_are_logged():
    assert known_channel("b", key("b", COMMAND)) is COMMAND
    assert known_channel("b", key("c", COMMAND)) is None
    assert known_channel("b", "softloop/b/nothing") is None
    assert known_channel("b", can_key("b", "can0", 0x80)) is CAN


def test_the_origin_is_read_once_from_both_clocks():
    origin = read_origin("b", 123)
    assert origin.log_time_ns(123) == origin.wall_ns > 1_700_000_000_000_000_000


def test_the_writer_can_flush():
    assert hasattr(Writer, "flush"), "mcap 1.6 or later is needed: a killed recorder would lose its chunk"
