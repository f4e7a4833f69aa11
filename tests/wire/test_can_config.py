"""Opening a bus from its table of the bench file, and the port that adapters use."""

from __future__ import annotations

import time

import can
import pytest

from softloop.wire.benchfile import load_model
from softloop.wire.can_config import CanConfig, open_bus
from softloop.wire.can_frame import ERROR_BUS_OFF, ERROR_RESTARTED, FLAG_ERROR, FLAG_EXTENDED, FLAG_REMOTE
from softloop.wire.can_zenoh import ZenohBus
from softloop.wire.errors import BadConfig, Unavailable
from tests.wire.can_ports import BENCH, WAIT_S, folder, log, ports, recv, wire

__all__ = ["folder", "log", "ports", "wire"]  # fixtures


def test_table_defaults_and_faults():
    assert CanConfig().interface == "zenoh"
    assert CanConfig().bitrate == 500_000
    assert CanConfig(interface="kvaser", channel=0).channel == 0
    for table, word in (
        (
            {"chanel": "can0"},
            "unknown key 'chanel'; allowed here: bitrate, channel, emulation, interface, mirror, open_wait_s, options, "
            "send_timeout_ms",
        ),
        ({"bitrate": 1}, "bitrate"),
        ({"options": {"channel": "x", "bitrate": 1}}, "bitrate, channel cannot stand in options"),
    ):
        with pytest.raises(BadConfig, match=word):
            load_model(CanConfig, table, "bench.toml")


@pytest.mark.parametrize(
    ("table", "word"),
    [
        ({"interface": "zeno"}, r"CAN interface 'zeno' is not known; there are: .*slcan.*zenoh"),
        ({"interface": "slcan", "channel": "/dev/no-such-device"}, "CAN bus slcan:/dev/no-such-device: .*No such file"),
        ({"interface": "slcan", "channel": "pty:///no-such-folder/x"}, "there is no folder"),
        ({"interface": "slcan", "channel": ""}, "Must specify a serial port"),
        ({"interface": "socketcan", "channel": "no-such-can"}, "CAN bus socketcan:no-such-can: "),
        ({"interface": "zenoh", "channel": "a/b"}, "channel 'a/b': a name without"),
        ({"interface": "zenoh", "options": {"fd": True}}, "not CAN FD"),
        ({"interface": "kvaser"}, "CAN bus kvaser:can0: "),
        ({"interface": "virtual", "options": {"nonsense": []}, "channel": "x", "bitrate": 500000}, None),
    ],
)
def test_what_cannot_be_opened_is_one_line(wire, table, word):
    config = load_model(CanConfig, table, "bench.toml")
    if word is None:  # an interface that takes anything takes this too
        open_bus(config, wire).shutdown()
        return
    with pytest.raises(Unavailable, match=word) as caught:
        open_bus(config, wire)
    assert "\n" not in str(caught.value)


def test_a_zenoh_bus_is_opened_on_the_wires_session_and_bench(wire):
    with open_bus(CanConfig(channel="valves"), wire) as bus:
        assert isinstance(bus, ZenohBus)
        assert f"bench {BENCH}" in bus.channel_info
    assert not wire.session.is_closed()


# The port: the same body over a bus on Zenoh and one that is not.


@pytest.fixture(params=["zenoh", "virtual"])
def interface(request):
    return request.param


def test_frames_pass_with_the_right_stamps(ports, interface):
    a, b = (ports(interface=interface, channel="c") for _ in range(2))
    b._clock.ns = 9_000
    assert a.send(0x80, b"abc", 5_000)
    assert a.send(0x80, bytes(8), 6_000)
    assert a.send(0x1000, b"", 7_000)
    got = [recv(b) for _ in range(3)]
    assert [f.stamp_ns for f in got] == ([5_000, 6_000, 7_000] if interface == "zenoh" else [9_000] * 3)
    assert [(f.arbitration_id, f.dlc, f.flags) for f in got] == [(0x80, 3, 0), (0x80, 8, 0), (0x1000, 0, FLAG_EXTENDED)]
    assert got[0].data == b"abc\0\0\0\0\0"
    assert [f.seq for f in got] == [1, 2, 3]
    assert a.recv(0.01) is None
    for bad in ((0x80, bytes(9)), (1 << 29, b""), (-1, b"")):
        with pytest.raises(ValueError, match="not a classic CAN frame"):
            a.send(*bad, 0)


def test_frames_of_a_zenoh_bus_are_not_doubled(ports, log):
    a, b = (ports(name="rig", channel="rig") for _ in range(2))
    a.send(0x80, b"1", 10)
    assert recv(b).arbitration_id == 0x80
    b.send(0x90, b"2", 20)
    assert recv(a).arbitration_id == 0x90
    time.sleep(0.05)
    assert [k for k, _ in log(2)] == [f"softloop/{BENCH}/can/rig/80", f"softloop/{BENCH}/can/rig/90"]


def test_a_bus_with_one_port_is_mirrored_whole(ports, log):
    device = can.Bus(interface="virtual", channel="dev", ignore_config=True)
    port = ports(name="dev", interface="virtual", channel="dev", options={"receive_own_messages": True})
    device.send(can.Message(arbitration_id=0x100, is_extended_id=False, data=b"in"))
    assert port.recv(WAIT_S).arbitration_id == 0x100
    port.send(0x80, b"out", 77)
    assert port.recv(WAIT_S).arbitration_id == 0x80  # its own, by the option, and not published twice
    device.send(can.Message(arbitration_id=0x10, is_extended_id=True, is_remote_frame=True, dlc=3))
    assert port.recv(WAIT_S).flags == FLAG_EXTENDED | FLAG_REMOTE
    time.sleep(0.05)
    seen = log(3)
    assert [(k.rsplit("/", 1)[1], f.data[: f.dlc]) for k, f in seen] == [("100", b"in"), ("80", b"out"), ("10", bytes(3))]
    assert seen[1][1].stamp_ns == 77
    device.shutdown()


def test_without_mirror_nothing_is_published(ports, wire, log):
    a = ports(name="quiet", interface="virtual", channel="q", mirror=False)
    a.send(0x80, b"", 0)
    wire.session.put(f"softloop/{BENCH}/can/end/0", b"")
    assert [k for k, _ in log(1)] == [f"softloop/{BENCH}/can/end/0"]


def test_only_asked_for_ids_and_error_frames_are_received(ports):
    a, b = ports(channel="f"), ports(channel="f", receive=[0x90])
    a.send(0x80, b"", 0)
    a.send(0x10090, b"", 0)
    a.send(0x90, b"", 0)
    a.bus.send_frame(ERROR_BUS_OFF, bytes(8), 0, FLAG_ERROR)
    assert [recv(b).arbitration_id for _ in range(2)] == [0x90, ERROR_BUS_OFF]


def test_bus_off_is_said_until_the_bus_is_back(ports, interface):
    a, b = (ports(interface=interface, channel="off") for _ in range(2))

    def error(classes):
        a.bus.send(can.Message(arbitration_id=classes, is_extended_id=False, is_error_frame=True, dlc=8, data=bytes(8)))
        assert recv(b).flags == FLAG_ERROR

    assert not b.bus_off
    error(ERROR_BUS_OFF)
    error(ERROR_BUS_OFF)
    assert (b.bus_off, b.bus_offs) == (True, 1)
    error(ERROR_RESTARTED)
    assert not b.bus_off
    error(ERROR_BUS_OFF)
    a.send(1, b"", 0)
    assert recv(b).arbitration_id == 1
    assert (b.bus_off, b.bus_offs) == (False, 2)


def test_a_bus_that_is_one_is_not_emulated():
    assert CanConfig(emulation={}).emulation.restart_ms == 100.0
    for table, word in (
        ({"interface": "socketcan", "emulation": {}}, "emulation is for interface 'zenoh'; 'socketcan' is a bus of its own"),
        ({"emulation": {"restart": 1}}, "unknown key 'emulation.restart'"),
        ({"emulation": {"error_rate": 2.0}}, "error_rate"),
        ({"options": {"through_bus": True}}, "through_bus cannot stand in options"),
    ):
        with pytest.raises(BadConfig, match=word):
            load_model(CanConfig, table, "bench.toml")
