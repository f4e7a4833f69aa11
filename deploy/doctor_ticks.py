"""The doctor's child: what a process of the 5 ms path sees of this machine, measured as such a process lives.

It takes priority and memory as they do, before any thread starts, so that what it measures is what they get. The answer is
one JSON object on standard output.
"""

from __future__ import annotations

import gc
import json
import struct
import sys
import time
from pathlib import Path
from typing import Any

from softloop.deploy.bench import Bench
from softloop.wire.clock import Deadlines, WallClock
from softloop.wire.errors import SoftloopError
from softloop.wire.messages import message
from softloop.wire.rights import DOCTOR_ROOT
from softloop.wire.schedule import PERIOD_NS
from softloop.wire.session import Inbox, Wire, open_wire
from softloop.wire.shell import prefer_realtime

PING, PONG = "ping", "pong"
ANSWER_S = 0.5  # a round trip that takes longer counts as lost
LINK_S = 5.0
_HEAD = struct.Struct("<Q")


def measure_as_child(bench: Bench, seconds: float) -> None:
    """Priority and memory, tick lateness, Zenoh round trips; `seconds` for each of the last two."""
    granted = prefer_realtime("doctor", bench.host)
    sys.setswitchinterval(5e-4)
    gc.collect()
    gc.freeze()
    gc.disable()
    answer: dict[str, Any] = {"realtime": granted, "locked_kib": locked_kib(), "host": bench.host.model_dump()}
    answer["late_ns"], answer["skipped"] = tick_lateness(round(seconds * 1e9 / PERIOD_NS))
    try:
        answer["round_trips_ns"], answer["lost"] = round_trips(bench, seconds)
    except SoftloopError as error:
        answer["zenoh_error"] = str(error)
    print(json.dumps(answer), flush=True)


def locked_kib() -> int:
    """How much memory of this process is locked, KiB, as the kernel says."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmLck:"):
            return int(line.split()[1])
    return 0


def tick_lateness(ticks: int, clock: WallClock | None = None) -> tuple[list[int], int]:
    """The controller's loop with nothing in it -> ns from each deadline to waking, and how many deadlines were skipped."""
    clock = clock or WallClock()
    late_ns: list[int] = []
    deadlines = Deadlines(PERIOD_NS, clock.now_ns() + PERIOD_NS)
    while deadlines.tick < ticks:
        clock.sleep_until_ns(deadlines.next_ns)
        late_ns.append(clock.now_ns() - deadlines.next_ns)
        deadlines.advance(clock.now_ns())
    return late_ns, deadlines.skipped_total


def round_trips(bench: Bench, seconds: float) -> tuple[list[int], int]:
    """Messages of a command's size, one a tick, to a second session and back -> ns of each, in order, and how many were lost.

    Raises Unavailable when a session cannot be opened.
    """
    with open_wire(bench.zenoh, bench.name, "doctor-a") as near, open_wire(bench.zenoh, bench.name, "doctor-b") as far:
        back = far.declare_publisher(_key(bench, PONG), realtime=True, sampled=True)
        echo = far.session.declare_subscriber(_key(bench, PING), lambda sample: back.put(sample.payload.to_bytes()))
        inbox = Inbox(near.session, _key(bench, PONG))
        for wire in (near, far):
            wire.settle(lambda: False)
        try:
            return _exchange(near, _key(bench, PING), inbox, round(seconds * 1e9 / PERIOD_NS))
        finally:
            echo.undeclare()


def _exchange(near: Wire, key: str, inbox: Inbox, count: int) -> tuple[list[int], int]:
    clock, publisher = WallClock(), near.declare_publisher(key, realtime=True, sampled=True)
    end_s = time.monotonic() + LINK_S
    while _trip(publisher, inbox, 0) is None and time.monotonic() < end_s:  # until both ends are joined
        pass
    trips_ns: list[int] = []
    deadlines = Deadlines(PERIOD_NS, clock.now_ns() + PERIOD_NS)
    for number in range(1, count + 1):
        clock.sleep_until_ns(deadlines.next_ns)
        trip_ns = _trip(publisher, inbox, number)
        trips_ns += [] if trip_ns is None else [trip_ns]
        deadlines.advance(clock.now_ns())
    return trips_ns, count - len(trips_ns)


def _trip(publisher: Any, inbox: Inbox, number: int) -> int | None:
    """One message there and back, ns; None when it is lost. Answers to earlier ones are passed over."""
    sent_ns = time.monotonic_ns()
    publisher.put(_HEAD.pack(number).ljust(message("ValveCommand").size, b"\0"))
    end_s = time.monotonic() + ANSWER_S
    while (left_s := end_s - time.monotonic()) > 0:
        item = inbox.take(left_s)
        if item is not None and _HEAD.unpack_from(item[1])[0] == number:
            return time.monotonic_ns() - sent_ns
    return None


def _key(bench: Bench, end: str) -> str:
    """Outside the bench's own keys: no recorder and no page hears it."""
    return f"{DOCTOR_ROOT}/{bench.name}/{end}"
