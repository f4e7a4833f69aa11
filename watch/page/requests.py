"""Asking the gate: arm and disarm by way of the page's wire, the emergency stop on a way of its own."""

from __future__ import annotations

import asyncio
import secrets
import threading
import time
from collections.abc import Callable
from typing import Any

from softloop.wire.channels import ARM, REQUEST, VALVES, key
from softloop.wire.messages import BadPayload, constant, message
from softloop.wire.session import Latest, Wire

ACTIONS = ("arm", "disarm", "stop")
WANTED = {
    "arm": constant("ValveStatus", "GATE_ARMED"),
    "disarm": constant("ValveStatus", "GATE_DISARMED"),
    "stop": constant("ValveStatus", "GATE_FAULT"),
}
FAULT = WANTED["stop"]
REPEAT_S = 0.2
ANSWER_S = 2.0
STOP_REPEAT_S = 0.02
STOP_FOR_S = 0.5


class Requester:
    """One who asks: a random name on the wire, and a count.

    Attributes:
        wire: by which it asks.
    """

    def __init__(self, wire: Wire, gate_stamp_ns: Callable[[], int] = lambda: 0) -> None:
        """`gate_stamp_ns()`: the stamp of the gate's newest word, which an arm request answers; 0 for none."""
        self.wire = wire
        self._gate_stamp_ns = gate_stamp_ns
        channels = (c for c in (REQUEST, ARM) if wire.may_put(c))
        self._publishers = {c.name: wire.declare_publisher(key(wire.bench, c), realtime=True) for c in channels}
        self._origin = secrets.randbits(63)
        self._seqs = {REQUEST.name: 0, ARM.name: 0}
        self._lock = threading.Lock()

    def send(self, action: str) -> None:
        """Publish one request. From any thread. Raises Unavailable when the page's identity has no right to it."""
        kind = message("GateRequest")
        channel = ARM if action == "arm" else REQUEST
        if channel.name not in self._publishers:
            raise self.wire.refused("publish on", channel)
        with self._lock:
            self._seqs[channel.name] += 1
            code = constant("GateRequest", f"ACTION_{action.upper()}")
            stamp_ns = self._gate_stamp_ns() if action == "arm" else time.monotonic_ns()
            made = kind.make(seq=self._seqs[channel.name], stamp_ns=stamp_ns, origin=self._origin, action=code)
            self._publishers[channel.name].put(kind.pack(made))


async def ask(send: Callable[[str], None], gate: Callable[[], tuple[int | None, float]], action: str) -> bool:
    """Ask until the gate, heard after the first request, is where `action` leads; False when it is not after `ANSWER_S`.

    `gate()` is its state and when it was heard, s. A gate in FAULT is asked once only: one press is one re-arm,
    and a disarm that goes on would take the next one back.
    """
    began_s = time.monotonic()
    sent_s, sends = 0.0, 0
    while time.monotonic() - began_s < ANSWER_S:
        state, heard_s = gate()
        if sends and heard_s > began_s + STOP_REPEAT_S and state == WANTED[action]:
            return True
        if time.monotonic() - sent_s >= REPEAT_S:
            if sends and action != "stop" and state == FAULT:
                return False
            send(action)
            sends, sent_s = sends + 1, time.monotonic()
        await asyncio.sleep(STOP_REPEAT_S)
    return False


class StopLine:
    """The emergency stop's own way to the gate: a Zenoh session and threads that carry nothing else.

    One press is published at once, in the thread that took it, and again every 20 ms until the gate is heard in FAULT.
    """

    def __init__(self) -> None:
        self._requester: Requester | None = None
        self._valves: Latest | None = None
        self._press = threading.Event()
        self._over = False
        self._thread = threading.Thread(target=self._repeat, name="stop", daemon=True)
        self._thread.start()
        self.presses = 0

    def connect(self, wire: Wire) -> None:
        """The bench is there."""
        self._valves = wire.latest(VALVES)
        self._requester = Requester(wire)

    @property
    def connected(self) -> bool:
        return self._requester is not None

    def press(self) -> bool:
        """Stop the rig. False when no bench was ever reached. From any thread."""
        self.presses += 1
        if self._requester is None:
            return False
        self._requester.send("stop")
        self._press.set()
        return True

    def close(self) -> None:
        self._over = True
        self._press.set()
        self._thread.join(2.0)

    def _repeat(self) -> None:
        while not self._over:
            self._press.wait()
            self._press.clear()
            end = time.monotonic() + STOP_FOR_S
            while not self._over and time.monotonic() < end:
                time.sleep(STOP_REPEAT_S)
                if self._in_fault() or self._requester is None:
                    break
                self._requester.send("stop")

    def _in_fault(self) -> bool:
        payload = self._valves.take() if self._valves is not None else None
        try:
            status: Any = message("ValveStatus").unpack(payload) if payload is not None else None
        except BadPayload:
            return False
        return status is not None and status.gate == FAULT
