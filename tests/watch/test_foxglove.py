"""The bridge to Foxglove, asked in its own protocol."""

import json
import os
import struct
import subprocess
import sys
import time

import pytest
from websockets.sync.client import connect

from softloop.deploy.foxglove import write_layout
from softloop.watch.config import FoxgloveConfig
from softloop.watch.foxglove import Bridge, Thinner
from softloop.wire.channels import CHANNELS, CYCLE, EVENT, STATUS, key
from softloop.wire.errors import Unavailable
from softloop.wire.mcap_layout import Origin
from softloop.wire.messages import message
from tests.watch.benches import repeating, speaking, write_bench
from tests.wire.rendezvous import short_folder

MS = 1_000_000


@pytest.mark.parametrize("rate_hz", [50.0, 30.0])
def test_a_fast_channel_is_thinned_evenly_and_a_slow_one_not(rate_hz):
    thinner = Thinner(rate_hz)
    passed = [t for t in range(0, 2000 * MS, 5 * MS) if thinner.passes("k", CYCLE, t)]
    assert len(passed) == pytest.approx(2 * rate_hz, abs=2)
    assert all(thinner.passes("s", STATUS, t) for t in range(100))
    assert all(thinner.passes("e", EVENT, 7) for _ in range(100))


def test_a_clock_that_jumps_does_not_silence_a_channel():
    thinner = Thinner(50.0)
    assert thinner.passes("k", CYCLE, 10**12)
    assert thinner.passes("k", CYCLE, 0)
    assert thinner.passes("k", CYCLE, 10**12)


def test_a_port_in_use_is_said():
    bridge = Bridge(FoxgloveConfig(port=0), Origin("b", 0, 0))
    try:
        port = int(bridge.address.rsplit(":", 1)[1])
        with pytest.raises(Unavailable, match=f"port {port}"):
            Bridge(FoxgloveConfig(port=port), Origin("b", 0, 0))
    finally:
        bridge.close()


def test_the_command_serves_a_bench_in_foxgloves_protocol():
    with short_folder() as folder:
        file = write_bench(folder, f"fox-{os.getpid()}")
        with (
            speaking(file) as speaker,
            repeating(lambda i: speaker.say("cycle", seq=i, stamp_ns=time.monotonic_ns(), angle_deg=42.5)),
        ):
            command = [sys.executable, "-m", "softloop.deploy.cli", "foxglove", str(file), "--port", "0"]
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
                try:
                    address = process.stdout.readline().removeprefix("Foxglove: ").strip()
                    channel, messages = subscribe(address, f"/{key(speaker.bench.name, CYCLE)}", 20)
                finally:
                    process.terminate()
                assert process.wait(20) == 0
    assert channel["encoding"] == "cdr"
    assert channel["schemaEncoding"] == "ros2msg"
    assert channel["schemaName"] == "softloop_msgs/msg/CycleRecord"
    kind = message("CycleRecord")
    stamps = [kind.unpack(payload).stamp_ns for _, payload in messages]
    assert all(kind.unpack(payload).angle_deg == 42.5 for _, payload in messages)
    assert (stamps[-1] - stamps[0]) / (len(stamps) - 1) > 15 * MS  # 200 Hz came, 50 Hz went
    assert messages[0][0] > 1_500_000_000 * 10**9  # wall time


def subscribe(address, topic, count):
    """(the channel as advertised, [(log time, payload)])."""
    with connect(address, subprotocols=["foxglove.sdk.v1"], proxy=None, max_size=None) as socket:
        channels = {}
        while topic not in channels:
            data = socket.recv(timeout=10)
            told = json.loads(data) if isinstance(data, str) else {}
            channels |= {c["topic"]: c for c in told.get("channels", [])}
        wanted = [{"id": 1, "channelId": channels[topic]["id"]}]
        socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        messages = []
        while len(messages) < count:
            data = socket.recv(timeout=10)
            if isinstance(data, bytes) and data[0] == 1:
                _, log_time = struct.unpack_from("<IQ", data, 1)
                messages.append((log_time, data[13:]))
    return channels[topic], messages


def test_the_layout_names_fields_that_there_are(tmp_path):
    assert write_layout(write_bench(tmp_path, "mine"), tmp_path / "layout.json") == 0
    layout = json.loads((tmp_path / "layout.json").read_text())
    by_name = {c.name: message(c.message) for c in CHANNELS}
    paths = [p["value"] for panel in layout["configById"].values() for p in panel.get("paths", [])]
    paths += [panel["topicPath"] for panel in layout["configById"].values() if "topicPath" in panel]
    assert len(paths) > 10
    for path in paths:
        _, root, bench, rest = path.split("/")
        name, _, field = rest.partition(".")
        assert (root, bench) == ("softloop", "mine")
        assert not field or field in {f.name for f in by_name[name].fields}
    assert set(json.dumps(layout["layout"]).split('"')) >= set(layout["configById"])
