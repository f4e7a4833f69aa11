"""Opening a bus from its table of the bench file, and the port that adapters use."""

from __future__ import annotations

import errno
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import can
import pytest
import serial

from softloop.wire.benchfile import load_model
from softloop.wire.can_config import CanConfig, open_bus, open_port
from softloop.wire.can_frame import ERROR_BUS_OFF, ERROR_RESTARTED, FLAG_ERROR, FLAG_EXTENDED, FLAG_REMOTE, unpack_frame
from softloop.wire.can_port import CanPort
from softloop.wire.can_zenoh import ZenohBus
from softloop.wire.channels import CAN
from softloop.wire.errors import BadConfig, Lost, Unavailable
from softloop.wire.serial_urls import open_serial
from softloop.wire.session import Wire, open_meeting

WAIT_S = 5.0
BENCH = "t"


class StepClock:
    """A clock that stands still until told."""

    def __init__(self) -> None:
        self.ns = 1_000

    def now_ns(self) -> int:
        return self.ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        self.ns = deadline_ns


@pytest.fixture
def folder():
    path = Path(tempfile.mkdtemp(prefix="sl", dir="/tmp"))
    yield path
    shutil.rmtree(path)


@pytest.fixture(scope="module")
def wire():
    path = Path(tempfile.mkdtemp(prefix="sl", dir="/tmp"))
    with open_meeting(BENCH, f"unixsock-stream/{path}/m.sock") as session:
        yield Wire(session, BENCH, "test")
    shutil.rmtree(path)


@pytest.fixture
def log(wire):
    """What a recorder would see on the CAN keys: (key, frame)."""
    seen = []
    subscriber = wire.session.declare_subscriber(
        f"softloop/{BENCH}/{CAN.name}/**", lambda s: seen.append((str(s.key_expr), unpack_frame(s.payload.to_bytes())))
    )
    yield lambda n: wait_for(lambda: len(seen) >= n) or seen
    subscriber.undeclare()


@pytest.fixture
def ports(wire):
    opened: list[CanPort] = []

    def start(name="p", receive=None, **table):
        port = open_port(load_model(CanConfig, table, "bench.toml"), name, wire, StepClock(), receive)
        opened.append(port)
        return port

    yield start
    for port in opened:
        port.close()
        port.close()


def wait_for(condition):
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def recv(port):
    """The next frame, however late this machine runs."""
    deadline = time.monotonic() + WAIT_S
    while (frame := port.recv(0.05)) is None and time.monotonic() < deadline:
        pass
    return frame


def keep_receiving(port):
    for _ in range(500):
        port.recv(0.01)


# The table.


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


class FaultyBus(can.BusABC):
    """A driver that answers as told."""

    channel_info = "faulty"

    def __init__(self) -> None:
        super().__init__("x")
        self.say: Exception | can.Message | None = None
        self.hang = threading.Event()

    def send(self, msg, timeout=None):
        if isinstance(self.say, Exception):
            raise self.say

    def _recv_internal(self, timeout):
        if isinstance(self.say, Exception):
            raise self.say
        return self.say, False

    def shutdown(self):
        super().shutdown()
        self.hang.wait(30)


@pytest.fixture
def faulty(wire):
    bus = FaultyBus()
    bus.hang.set()
    port = CanPort(bus, "x", wire, StepClock())
    yield bus, port
    bus.hang.set()
    port.close()


def caused(outer, inner):
    outer.__cause__ = inner
    return outer


@pytest.mark.parametrize("fault", [can.CanOperationError("gone"), OSError(5, "I/O error"), RuntimeError("driver bug")])
def test_a_device_that_is_gone_is_one_line(faulty, fault):
    bus, port = faulty
    bus.say = fault
    for use in (lambda: port.recv(0.01), lambda: port.send(1, b"", 0)):
        with pytest.raises(Lost, match=r"CAN bus 'x' \(faulty\) is lost: ") as caught:
            use()
        assert "\n" not in str(caught.value)


def test_an_interface_that_is_down_is_bus_off(faulty):
    bus, port = faulty
    bus.say = can.CanOperationError("Network is down", errno.ENETDOWN)
    start = time.monotonic()
    assert port.recv(0.05) is None
    assert time.monotonic() - start >= 0.04  # no busy loop
    assert (port.bus_off, port.bus_offs) == (True, 1)
    assert not port.send(1, b"", 0)
    assert port.unsent == 1
    bus.say = can.Message(arbitration_id=3, is_extended_id=False)
    assert port.recv(0).arbitration_id == 3
    assert not port.bus_off


@pytest.mark.parametrize(
    "fault",
    [
        can.CanOperationError("No buffer space available", errno.ENOBUFS),
        can.CanTimeoutError("later"),
        caused(can.CanOperationError("Could not write to serial device"), serial.SerialTimeoutException("Write timeout")),
    ],
)
def test_a_frame_that_does_not_get_out_is_counted(faulty, fault):
    bus, port = faulty
    bus.say = fault
    assert not port.send(1, b"", 0)
    assert (port.unsent, port.bus_off) == (1, False)


def test_noise_is_counted_and_endless_noise_is_a_loss(faulty):
    bus, port = faulty
    bus.say = ValueError("invalid literal for int()")
    assert port.recv(0.0) is None
    assert port.malformed == 1
    with pytest.raises(Lost):
        keep_receiving(port)
    bus.say = can.Message(arbitration_id=1, is_fd=True, data=bytes(12))
    before = port.malformed
    assert port.recv(0) is None
    assert port.malformed > before


def test_a_driver_that_does_not_let_go_is_left_behind(faulty):
    bus, port = faulty
    bus.hang.clear()
    start = time.monotonic()
    port.close()
    assert time.monotonic() - start < 10


# A serial CAN adapter on one of our pseudo-terminals.

OTHER_END = """
import sys, can, softloop.wire.serial_urls
bus = can.Bus(interface="slcan", channel=sys.argv[1], sleep_after_open=0, ignore_config=True)
print("up", flush=True)
while (msg := bus.recv(10)) is not None:
    bus.send(msg)
"""
SLCAN = {"interface": "slcan", "options": {"sleep_after_open": 0}}


def test_slcan_port_over_a_pty_with_noise_on_the_line(ports, folder):
    with open_serial(f"pty://{folder}/can1", 115200, 0.1) as line:
        port = ports(channel=f"{folder}/can1", **SLCAN)
        line.write(b"\r\xff\xfe\rtzz\r\at1\r")
        deadline = time.monotonic() + WAIT_S
        while port.malformed == 0 or port.recv(0.02) is not None or port.bus.serialPortOrig.in_waiting:
            assert time.monotonic() < deadline
            port.recv(0.02)
        line.write(b"t1232AABB\r")
        first = recv(port)
        assert (first.arbitration_id, first.data[: first.dlc]) == (0x123, b"\xaa\xbb")
        line.write(b"z\rt1000\rz\rt1010\r")  # acknowledgements between frames
        wait_for(lambda: port.bus.serialPortOrig.in_waiting == 16)
        assert [port.recv(0).arbitration_id for _ in range(2)] == [0x100, 0x101]
        assert port.recv(0) is None


def test_a_device_file_that_comes_later_is_waited_for(ports, folder):
    lines = []
    later = threading.Timer(0.3, lambda: lines.append(open_serial(f"pty://{folder}/can1", 115200, 0.1)))
    later.start()
    port = ports(channel=f"{folder}/can1", open_wait_s=20.0, **SLCAN)
    later.join()
    with lines[0]:
        lines[0].write(b"t1232AABB\r")
        assert recv(port).arbitration_id == 0x123


def test_slcan_peer_killed_is_a_loss(ports, folder):
    other = subprocess.Popen([sys.executable, "-c", OTHER_END, f"pty://{folder}/can1"], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "up\n"
        port = ports(channel=f"{folder}/can1", **SLCAN)
        assert port.send(0x80, b"ping", 0)
        assert recv(port).data[:4] == b"ping"
    finally:
        other.kill()
        other.wait(WAIT_S)
        other.stdout.close()
    with pytest.raises(Lost, match="CAN bus 'p'"):
        keep_receiving(port)
    with pytest.raises(Lost):
        port.send(0x80, b"", 0)


def test_slcan_peer_frozen_hangs_nobody(ports, folder):
    other = subprocess.Popen([sys.executable, "-c", OTHER_END, f"pty://{folder}/can1"], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "up\n"
        port = ports(channel=f"{folder}/can1", **SLCAN)
        other.send_signal(signal.SIGSTOP)
        start = time.monotonic()
        while port.send(0x80, bytes(8), 0):
            assert time.monotonic() - start < 30
        assert port.unsent == 1
        assert port.recv(0.01) is None
        port.close()
    finally:
        other.kill()
        other.wait(WAIT_S)
        other.stdout.close()


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
