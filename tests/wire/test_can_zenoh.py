"""The python-can interface `zenoh`: what python-can documents for every interface, and what is our own."""

from __future__ import annotations

import os
import select
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
from hypothesis import given
from hypothesis import strategies as st

from softloop.wire.can_frame import (
    ERROR_BUS_OFF,
    ERROR_CONTROLLER,
    ERROR_RESTARTED,
    FLAG_ERROR,
    FLAG_EXTENDED,
    FLAG_REMOTE,
    FRAME_SIZE,
    CanFrame,
    pack_frame,
    unpack_frame,
)
from softloop.wire.can_zenoh import ZenohBus
from softloop.wire.channels import can_key
from softloop.wire.session import open_meeting

BENCH = "t"
WAIT_S = 5.0  # far more than anything here takes; a test that fails waits so long

ECHO = """
import sys, can
kwargs = {"endpoint": sys.argv[1], "bench": "t"} if sys.argv[1] else {}
bus = can.Bus(interface="zenoh", channel="can0", **kwargs)
print("ready", flush=True)
while (msg := bus.recv(10)) is not None and msg.arbitration_id != 0x7FF:
    msg.arbitration_id += 1
    bus.send(msg)
bus.shutdown()
"""


@pytest.fixture
def folder():
    path = Path(tempfile.mkdtemp(prefix="sl", dir="/tmp"))
    yield path
    shutil.rmtree(path)


@pytest.fixture
def endpoint(folder):
    return f"unixsock-stream/{folder}/m.sock"


@pytest.fixture(scope="module")
def session():
    path = Path(tempfile.mkdtemp(prefix="sl", dir="/tmp"))
    with open_meeting(BENCH, f"unixsock-stream/{path}/m.sock") as opened:
        yield opened
    shutil.rmtree(path)


@pytest.fixture
def echo():
    """Start echoing processes; whatever still runs at the end is killed."""
    running: list[subprocess.Popen[str]] = []

    def start(endpoint: str, **more: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", ECHO, endpoint], stdout=subprocess.PIPE, text=True, env={**os.environ, **more}
        )
        running.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    yield start
    for process in running:
        process.kill()
        process.wait(WAIT_S)
        process.stdout.close()


def zenoh_bus(session, **kwargs):
    return can.Bus(interface="zenoh", channel="can0", bench=BENCH, session=session, ignore_config=True, **kwargs)


def standard(arbitration_id, data=b""):
    return can.Message(arbitration_id=arbitration_id, is_extended_id=False, data=data)


def drain(bus):
    return list(iter(lambda: bus.recv(0), None))


@given(st.binary(max_size=64) | st.binary(min_size=FRAME_SIZE, max_size=FRAME_SIZE))
def test_any_bytes_on_the_keys_are_counted_and_harm_nothing(session, payload):
    with zenoh_bus(session) as bus, zenoh_bus(session) as other:
        session.put(can_key(BENCH, "can0", 0x10), payload)
        frame = unpack_frame(payload)
        good = frame is not None and frame.arbitration_id == 0x10
        assert bus.malformed == (0 if good else 1)
        assert len(drain(bus)) == int(good)
        other.send(standard(0x10))
        assert bus.recv(WAIT_S).arbitration_id == 0x10


@pytest.mark.parametrize(
    "change",
    [
        {"dlc": 9},
        {"dlc": 255},
        {"flags": 8},
        {"flags": 255},
        {"flags": FLAG_ERROR | FLAG_REMOTE},
        {"arbitration_id": 0x800},
        {"arbitration_id": 1 << 29, "flags": FLAG_EXTENDED},
        {"arbitration_id": 0x11},  # a frame under another one's key
    ],
)
def test_frames_that_cannot_be_are_counted(session, change):
    good = CanFrame(1, 2, 3, 0x10, 0, 2, b"ab".ljust(8, b"\0"))
    bad = good._replace(**change)
    key = can_key(BENCH, "can0", 0x10 if change == {"arbitration_id": 0x11} else bad.arbitration_id)
    with zenoh_bus(session) as bus:
        session.put(key, pack_frame(bad))
        session.put(can_key(BENCH, "can0", 0x10), b"\x00\x00\x00\x00" + pack_frame(good)[4:])  # another CDR header
        session.delete(can_key(BENCH, "can0", 0x10))
        assert bus.malformed == 3
        session.put(can_key(BENCH, "can0", 0x10), pack_frame(good))
        assert drain(bus)[0].data == b"ab"


def test_recv_frame_keeps_the_exact_stamp(session):
    with zenoh_bus(session) as a, zenoh_bus(session) as b:
        stamp_ns = 2**53 + 1  # a float64 does not hold it
        a.send_frame(0x80, b"xyz", stamp_ns)
        a.send_frame(0x81, b"", stamp_ns, FLAG_EXTENDED)
        first, second = b.recv_frame(WAIT_S), b.recv_frame(0)
        assert (first.stamp_ns, first.seq, first.dlc, first.data) == (stamp_ns, 1, 3, b"xyz\0\0\0\0\0")
        assert (second.seq, second.flags) == (2, FLAG_EXTENDED)
        assert first.node == second.node != 0
        before = time.monotonic_ns()
        a.send(standard(1))
        assert before <= b.recv_frame(WAIT_S).stamp_ns <= time.monotonic_ns()
        with pytest.raises(ValueError, match="9 bytes"):
            a.send_frame(0x80, bytes(9), 0)


def test_a_full_queue_drops_the_oldest_and_counts(session):
    with zenoh_bus(session) as a, zenoh_bus(session, rx_queue_size=3) as b:
        for i in range(5):
            a.send(standard(i))
        assert [m.arbitration_id for m in drain(b)] == [2, 3, 4]
        assert b.dropped == 2
        assert b.lost == 0


def test_gaps_in_a_senders_counter_are_counted(session):
    with zenoh_bus(session) as bus:
        for seq in (5, 6, 9, 7):
            session.put(can_key(BENCH, "can0", 1), pack_frame(CanFrame(seq, 0, 77, 1, 0, 0, bytes(8))))
        assert bus.lost == 2
        assert len(drain(bus)) == 4


def test_shutdown_wakes_a_blocked_recv(session):
    bus = zenoh_bus(session)
    ended: list[BaseException] = []

    def receive():
        try:
            bus.recv(None)
        except can.CanOperationError as error:
            ended.append(error)

    thread = threading.Thread(target=receive)
    thread.start()
    time.sleep(0.05)
    bus.shutdown()
    thread.join(WAIT_S)
    assert not thread.is_alive()
    assert len(ended) == 1


def test_shutdown_while_others_send(session):
    for _ in range(20):
        bus = zenoh_bus(session)
        faults: list[Exception] = []

        def keep_sending(bus=bus, faults=faults):
            try:
                while True:
                    bus.send(standard(1))
            except can.CanOperationError:
                pass
            except Exception as error:  # noqa: BLE001 - whatever it is, the test shows it
                faults.append(error)

        threads = [threading.Thread(target=keep_sending) for _ in range(2)]
        for thread in threads:
            thread.start()
        time.sleep(0.005)
        bus.shutdown()
        for thread in threads:
            thread.join(WAIT_S)
        assert not any(thread.is_alive() for thread in threads)
        assert faults == []


def test_fileno_is_readable_while_frames_wait(session):
    with zenoh_bus(session) as a, zenoh_bus(session) as b:
        a.send(standard(1))

        def readable():
            return bool(select.select([b.fileno()], [], [], 0)[0])

        assert readable()
        a.send(standard(2))
        b.recv(0)
        assert readable()
        b.recv(0)
        assert not readable()
        a.send(standard(3))
        assert readable()
        b.set_filters([{"can_id": 9, "can_mask": 0x7FF}])
        assert not readable()
    with pytest.raises(can.CanOperationError):
        b.fileno()


def test_state_follows_error_frames_and_filters_let_them_pass(session):
    none = [{"can_id": 0x7FF, "can_mask": 0x7FF}]
    with zenoh_bus(session) as a, zenoh_bus(session, can_filters=none) as b:

        def after(classes, detail=0):
            data = bytes([0, detail, 0, 0, 0, 0, 0, 0])
            a.send(can.Message(arbitration_id=classes, is_extended_id=False, is_error_frame=True, dlc=8, data=data))
            return b.state

        assert after(ERROR_CONTROLLER, 0x20) == can.BusState.PASSIVE
        assert after(ERROR_BUS_OFF) == can.BusState.ERROR
        assert after(ERROR_RESTARTED) == can.BusState.ACTIVE
        assert after(ERROR_CONTROLLER, 0x04) == can.BusState.ACTIVE
        assert a.state == can.BusState.ACTIVE
        assert all(m.is_error_frame and m.dlc == 8 for m in drain(b))
        a.send(can.Message(arbitration_id=ERROR_BUS_OFF, is_error_frame=True, dlc=8))  # as short as it can be written
        assert bytes(b.recv(WAIT_S).data) == bytes(8)


def test_what_is_refused(session):
    with pytest.raises(ValueError, match="CAN FD"):
        zenoh_bus(session, fd=True)
    with pytest.raises(ValueError, match="rx_queue_size"):
        zenoh_bus(session, rx_queue_size=0)
    for name in ("", "a/b", "*", "@x", "a b", "a#"):
        with pytest.raises(ValueError, match="channel"):
            can.Bus(interface="zenoh", channel=name, session=session, ignore_config=True)
    with zenoh_bus(session) as bus, pytest.raises(ValueError, match="FD"):
        bus.send(can.Message(arbitration_id=1, is_fd=True, data=bytes(12)))


def test_what_is_ignored(session):
    with zenoh_bus(session, bitrate=500000, fd=False, timing=None, state=can.BusState.ACTIVE, app_name="x", port=7000) as bus:
        assert isinstance(bus, ZenohBus)
        assert "can0" in bus.channel_info
        assert bus.protocol == can.CanProtocol.CAN_20
        bus.flush_tx_buffer()


def test_an_endpoint_that_cannot_be_used_is_one_error():
    with pytest.raises(can.CanInitializationError, match="there is no folder"):
        can.Bus(interface="zenoh", channel="can0", endpoint="unixsock-stream//nowhere/m.sock", ignore_config=True)


def test_a_closed_session_is_one_error(endpoint):
    session = open_meeting(BENCH, endpoint)
    bus = zenoh_bus(session)
    session.close()
    with pytest.raises(can.CanOperationError, match="session"):
        bus.send(standard(1))
    assert bus.recv(0) is None
    bus.shutdown()
    with pytest.raises(can.CanInitializationError, match="session"):
        zenoh_bus(session)


def test_an_injected_session_stays_open(session):
    zenoh_bus(session).shutdown()
    assert not session.is_closed()


def test_two_processes_with_no_other_argument_find_each_other(folder, monkeypatch, echo):
    for name in ("HOME", "XDG_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(folder))
    peer = echo("")
    with can.Bus(interface="zenoh", channel="can0") as bus:
        bus.send(standard(0x10, b"hello"))  # at once: nothing is lost at the start
        got = bus.recv(WAIT_S)
        assert (got.arbitration_id, bytes(got.data)) == (0x11, b"hello")
        assert can.detect_available_configs("zenoh") == [{"interface": "zenoh", "channel": "can0"}]
        bus.send(standard(0x7FF))
    assert peer.wait(WAIT_S) == 0
    assert can.detect_available_configs("zenoh") == [{"interface": "zenoh", "channel": "can0"}]


def test_what_is_sent_just_before_shutdown_arrives(endpoint, echo):
    with can.Bus(interface="zenoh", channel="can0", bench=BENCH, endpoint=endpoint, ignore_config=True) as bus:
        code = ECHO.split("print", maxsplit=1)[0]
        code += "for i in range(200):\n    bus.send(can.Message(arbitration_id=i))\nbus.shutdown()"
        subprocess.run([sys.executable, "-c", code, endpoint], check=True, timeout=30)
        assert [bus.recv(WAIT_S).arbitration_id for _ in range(200)] == list(range(200))
        assert (bus.lost, bus.dropped, bus.malformed) == (0, 0, 0)


def test_a_killed_peer_hangs_nobody_and_the_next_one_is_found(endpoint, echo):
    first = echo(endpoint)  # it is the meeting point
    with can.Bus(interface="zenoh", channel="can0", bench=BENCH, endpoint=endpoint, ignore_config=True) as bus:
        bus.send(standard(0x10))
        assert bus.recv(WAIT_S).arbitration_id == 0x11
        first.kill()
        first.wait(WAIT_S)
        for _ in range(300):
            bus.send(standard(0x20))
        drain(bus)
        assert bus.recv(0.1) is None
        echo(endpoint)
        deadline = time.monotonic() + WAIT_S
        got = None
        while got is None and time.monotonic() < deadline:
            bus.send(standard(0x30))
            got = bus.recv(0.1)
        assert got is not None
        assert got.arbitration_id == 0x31


def test_a_frozen_peer_holds_up_neither_open_nor_send_nor_shutdown(endpoint, echo):
    peer = echo(endpoint)
    arguments = {"interface": "zenoh", "channel": "can0", "bench": BENCH, "endpoint": endpoint, "ignore_config": True}
    first = can.Bus(**arguments)
    os.kill(peer.pid, signal.SIGSTOP)
    try:
        start = time.monotonic()
        for _ in range(5000):
            first.send(standard(1))
        can.Bus(**arguments).shutdown()
        first.shutdown()
        assert time.monotonic() - start < 8.0  # with Zenoh's own limits it is more than 10 s
    finally:
        os.kill(peer.pid, signal.SIGCONT)


def test_a_program_that_forgets_shutdown_ends(endpoint):
    code = ECHO.split("print", maxsplit=1)[0] + "bus.send(can.Message(arbitration_id=1))"
    assert subprocess.run([sys.executable, "-c", code, endpoint], timeout=30, check=False).returncode == 0
