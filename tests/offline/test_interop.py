"""Our logs in the readers of others: equal values, by their own decoding."""

import pytest
import synthetic
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from softloop.wire.messages import message

MADE = list(synthetic.messages(0.2))


def expected(key):
    return [value for _, k, value in MADE if k == key]


def assert_equal(kind, ours, theirs):
    for field in kind.fields:
        value = getattr(theirs, field.name)
        assert (tuple(value) if field.length else value) == getattr(ours, field.name), field.name


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return synthetic.write_log(tmp_path_factory.mktemp("interop") / "run.mcap", MADE)


def test_mcap_ros2_decodes_equal_values(file):
    seen = {}
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, found, decoded in reader.iter_decoded_messages(log_time_order=False):
            seen.setdefault(channel.topic, []).append((found, decoded))
    assert set(seen) == {f"/{key}" for _, key, _ in MADE}
    for topic, decoded in seen.items():
        ours = expected(topic[1:])
        assert len(decoded) == len(ours)
        kind = message(type(ours[0]).__name__)
        for (found, theirs), value in zip(decoded, ours, strict=True):
            assert found.sequence == value.seq
            assert found.log_time == synthetic.ORIGIN.log_time_ns(value.stamp_ns)
            assert_equal(kind, value, theirs)


def test_rosbags_reads_equal_values_with_the_definitions_of_the_file(file):
    seen = {}
    with AnyReader([file]) as reader:
        for connection, log_time, raw in reader.messages():
            assert connection.msgtype.startswith("softloop_msgs/msg/")
            decoded = reader.deserialize(raw, connection.msgtype)
            seen.setdefault(connection.topic, []).append((log_time, decoded))
    assert set(seen) == {f"/{key}" for _, key, _ in MADE}
    for topic, decoded in seen.items():
        ours = sorted(expected(topic[1:]), key=lambda m: m.stamp_ns)
        assert len(decoded) == len(ours)
        for (log_time, theirs), value in zip(decoded, ours, strict=True):
            assert log_time == synthetic.ORIGIN.log_time_ns(value.stamp_ns)
            assert_equal(message(type(value).__name__), value, theirs)
