"""The python-can interface `zenoh`: what python-can documents for every interface, and what is our own."""

from __future__ import annotations

import asyncio
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
    from_message,
    pack_frame,
    to_message,
    unpack_frame,
)
from softloop.wire.can_zenoh import ZenohBus
from softloop.wire.channels import can_key
from softloop.wire.messages import message
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


# The same body over python-can's own virtual bus and ours: what is documented for all interfaces.


@pytest.fixture(params=["virtual", "zenoh one session", "zenoh two sessions"])
def pair(request, session):
    opened: list[can.BusABC] = []

    def start(**kwargs):
        if request.param == "virtual":
            arguments = {"interface": "virtual", "channel": "pair", "ignore_config": True}
        elif request.param == "zenoh one session":
            arguments = {"interface": "zenoh", "channel": "pair", "bench": BENCH, "session": session, "ignore_config": True}
        else:
            endpoint = f"unixsock-stream/{request.getfixturevalue('folder')}/m.sock"
            arguments = {"interface": "zenoh", "channel": "pair", "endpoint": endpoint, "ignore_config": True}
        opened.extend(can.Bus(**arguments, **kwargs) for _ in range(2))
        return opened[-2:]

    yield start
    for bus in opened:
        bus.shutdown()


MESSAGES = [
    standard(0x123, b"\x01\x02\x03"),
    standard(0, b""),
    standard(0x7FF, bytes(range(8))),
    can.Message(arbitration_id=0x1FFFFFFF, is_extended_id=True, data=b"\xff"),
    can.Message(arbitration_id=0x12, is_extended_id=True, data=b""),
    can.Message(arbitration_id=0x55, is_extended_id=False, is_remote_frame=True, dlc=4),
    can.Message(arbitration_id=0x155555, is_extended_id=True, is_remote_frame=True, dlc=8),
    can.Message(arbitration_id=ERROR_BUS_OFF, is_extended_id=False, is_error_frame=True, dlc=8, data=bytes(8)),
]


def test_frames_of_every_kind_arrive_in_order_at_the_other_bus_only(pair):
    a, b = pair()
    for msg in MESSAGES:
        a.send(msg)
    for msg in MESSAGES:
        got = b.recv(WAIT_S)
        assert got is not None
        assert got.equals(msg, timestamp_delta=None, check_channel=False)
        assert got.is_rx
    assert b.recv(0.05) is None
    assert a.recv(0) is None


def test_own_messages_come_back_only_when_asked_for(pair):
    a, b = pair(receive_own_messages=True)
    a.send(standard(1))
    own, other = a.recv(WAIT_S), b.recv(WAIT_S)
    assert (own.arbitration_id, own.is_rx) == (1, False)
    assert (other.arbitration_id, other.is_rx) == (1, True)


@pytest.mark.parametrize(
    ("filters", "ids"),
    [
        (None, [0x10, 0x11, 0x20, 0x10, 0x7FF]),
        ([], [0x10, 0x11, 0x20, 0x10, 0x7FF]),
        ([{"can_id": 0x10, "can_mask": 0x7FF}], [0x10, 0x10]),
        ([{"can_id": 0x10, "can_mask": 0x7FF, "extended": True}], [0x10]),
        ([{"can_id": 0x10, "can_mask": 0x7F0, "extended": False}], [0x10, 0x11]),
        ([{"can_id": 0x11, "can_mask": 0x7FF}, {"can_id": 0x20, "can_mask": 0x7FF}], [0x11, 0x20]),
        ([{"can_id": 0x400, "can_mask": 0x400}], [0x7FF]),
    ],
)
def test_filters(pair, filters, ids):
    a, b = pair(can_filters=filters)
    for msg in (standard(0x10), standard(0x11), standard(0x20), can.Message(arbitration_id=0x10, is_extended_id=True)):
        a.send(msg)
    a.send(standard(0x7FF))
    got = [b.recv(WAIT_S).arbitration_id for _ in ids]
    assert got == ids
    assert b.recv(0.05) is None


def test_a_filter_set_later_holds_for_frames_that_wait(pair):
    a, b = pair()
    for i in (1, 2, 3):
        a.send(standard(i))
    assert b.recv(WAIT_S).arbitration_id == 1
    b.set_filters([{"can_id": 3, "can_mask": 0x7FF}])
    assert b.recv(WAIT_S).arbitration_id == 3
    assert b.recv(0) is None


def test_timeouts_of_recv(pair):
    a, b = pair()
    assert b.recv(0) is None
    start = time.monotonic()
    assert b.recv(0.1) is None
    assert time.monotonic() - start >= 0.09
    threading.Timer(0.05, a.send, [standard(9)]).start()
    assert b.recv().arbitration_id == 9


def test_iteration_and_notifier_thread(pair):
    a, b = pair()
    a.send(standard(1))
    assert next(iter(b)).arbitration_id == 1
    reader = can.BufferedReader()
    with can.Notifier(b, [reader], timeout=0.05):
        a.send(standard(2))
        assert reader.get_message(WAIT_S).arbitration_id == 2


def test_notifier_with_asyncio(pair):
    a, b = pair()

    async def receive():
        reader = can.AsyncBufferedReader()
        notifier = can.Notifier(b, [reader], timeout=0.05, loop=asyncio.get_running_loop())
        for i in range(5):
            a.send(standard(i))
        got = [(await asyncio.wait_for(reader.get_message(), WAIT_S)).arbitration_id for _ in range(5)]
        notifier.stop()
        return got

    assert asyncio.run(receive()) == list(range(5))


def test_send_periodic(pair):
    a, b = pair()
    task = a.send_periodic(standard(5), 0.005)
    assert [b.recv(WAIT_S).arbitration_id for _ in range(3)] == [5, 5, 5]
    task.stop()


def test_shutdown_twice_and_what_follows(pair):
    a, b = pair()
    a.shutdown()
    a.shutdown()
    with pytest.raises(can.CanOperationError):
        a.send(standard(1))
    with pytest.raises(can.CanOperationError):
        a.recv(0)
    b.send(standard(1))  # nobody there: no error, no wait
    assert b.state == can.BusState.ACTIVE


# Ours alone.


@given(
    st.integers(0, 2**64 - 1), st.integers(-(2**63), 2**63 - 1), st.integers(0, 2**29 - 1), st.binary(max_size=8), st.booleans()
)
def test_frame_bytes_are_those_of_the_message_definition(seq, stamp_ns, arbitration_id, data, remote):
    flags = FLAG_EXTENDED | (FLAG_REMOTE if remote else 0)
    frame = CanFrame(seq, stamp_ns, seq, arbitration_id, flags, len(data), data.ljust(8, b"\0"))
    kind = message("CanFrame")
    assert CanFrame._fields == kind.Tuple._fields
    assert pack_frame(frame) == kind.pack(frame)
    assert unpack_frame(pack_frame(frame)) == frame
    there = kind.unpack(pack_frame(frame))
    assert (*there[:-1], bytes(there.data)) == frame


@given(
    st.builds(
        can.Message,
        arbitration_id=st.integers(-5, 2**29 + 5),
        is_extended_id=st.booleans(),
        is_remote_frame=st.booleans(),
        is_error_frame=st.booleans(),
        dlc=st.none() | st.integers(-1, 10),
        data=st.binary(max_size=10),
        is_fd=st.booleans(),
    )
)
def test_a_message_is_carried_as_it_is_or_refused(msg):
    try:
        frame = from_message(msg, 1, 2, 3)
    except ValueError:
        with pytest.raises(ValueError, match=".") if not msg.is_fd else pytest.raises(ValueError, match="FD"):
            from_message(msg, 1, 2, 3)
        return
    assert unpack_frame(pack_frame(frame)) == frame
    back = to_message(frame, "c", is_rx=True)
    if msg.is_error_frame and not msg.data:
        msg.data = bytearray(msg.dlc)
    assert back.equals(msg, timestamp_delta=None, check_channel=False)
    back._check()


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
        code = ECHO.split("print")[0] + "for i in range(200):\n    bus.send(can.Message(arbitration_id=i))\nbus.shutdown()"
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
    code = ECHO.split("print")[0] + "bus.send(can.Message(arbitration_id=1))"
    assert subprocess.run([sys.executable, "-c", code, endpoint], timeout=30, check=False).returncode == 0
