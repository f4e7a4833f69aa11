"""What a port says of devices that break: gone, down, full, noisy, frozen."""

from __future__ import annotations

import errno
import signal
import subprocess
import sys
import threading
import time

import can
import pytest
import serial

from softloop.wire.can_port import CanPort
from softloop.wire.errors import Lost
from softloop.wire.serial_urls import open_serial
from tests.wire.can_ports import WAIT_S, StepClock, folder, keep_receiving, log, ports, recv, wait_for, wire

__all__ = ["folder", "log", "ports", "wire"]  # fixtures


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
