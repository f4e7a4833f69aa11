"""What python-can documents for every interface: one body over its own `virtual` bus and over ours."""

from __future__ import annotations

import asyncio
import shutil
import tempfile
import threading
import time
from pathlib import Path

import can
import pytest

from softloop.wire.can_frame import ERROR_BUS_OFF
from softloop.wire.session import open_meeting

BENCH = "t"
WAIT_S = 5.0  # far more than anything here takes; a test that fails waits so long


@pytest.fixture
def folder():
    path = Path(tempfile.mkdtemp(prefix="sl", dir="/tmp"))
    yield path
    shutil.rmtree(path)


@pytest.fixture(scope="module")
def session():
    path = Path(tempfile.mkdtemp(prefix="sl", dir="/tmp"))
    with open_meeting(BENCH, f"unixsock-stream/{path}/m.sock") as opened:
        yield opened
    shutil.rmtree(path)


def standard(arbitration_id, data=b""):
    return can.Message(arbitration_id=arbitration_id, is_extended_id=False, data=data)


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
