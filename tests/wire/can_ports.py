"""Ports as adapters open them, on a Zenoh session of the test's own."""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path

import pytest

from softloop.wire.benchfile import load_model
from softloop.wire.can_config import CanConfig, open_port
from softloop.wire.can_frame import unpack_frame
from softloop.wire.can_port import CanPort
from softloop.wire.channels import CAN
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
