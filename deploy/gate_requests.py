"""Asking the gate to arm, disarm or stop, until it says what it did."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from typing import Literal

from softloop.deploy.rig_state import GATE_ARMED, GATE_DISARMED, GATE_FAULT, RigState
from softloop.wire.channels import REQUEST
from softloop.wire.messages import constant, message
from softloop.wire.session import Wire

Action = Literal["arm", "disarm", "stop"]
WANTED = {"arm": GATE_ARMED, "disarm": GATE_DISARMED, "stop": GATE_FAULT}
# A request can be lost (nothing on the wires waits), so it is said again until the gate is where it should be.
REPEAT_NS = 200_000_000
POLL_S = 0.02


class Requests:
    """One requester: its random name on the wire, and its count."""

    def __init__(self, wire: Wire) -> None:
        self._put = wire.publisher(REQUEST)
        self._origin = secrets.randbits(63)
        self._seq = 0

    def send(self, action: Action) -> None:
        """Publish one request."""
        self._seq += 1
        request = message("GateRequest")
        code = constant("GateRequest", f"ACTION_{action.upper()}")
        self._put(request.pack(request.make(seq=self._seq, stamp_ns=time.monotonic_ns(), origin=self._origin, action=code)))


def ask(
    requests: Requests,
    state: RigState,
    action: Action,
    timeout_s: float,
    *,
    give_up: Callable[[], bool] = lambda: False,
    on_event: Callable[[str], None] = lambda line: None,
) -> bool:
    """Ask until the gate has said, after the first request, that it is where `action` leads.

    Returns False after `timeout_s`, when `give_up()` says so, and when the gate went to FAULT instead. A gate that was in
    FAULT before is asked to arm once only: one word of a person is one re-arm.
    """
    began_ns = time.monotonic_ns()
    sent_ns = 0
    sends = 0
    while time.monotonic_ns() - began_ns < timeout_s * 1e9 and not give_up():
        for line in state.refresh():
            on_event(line)
        if sent_ns and state.valves_heard_ns > sent_ns and state.gate == WANTED[action]:
            return True
        if time.monotonic_ns() - sent_ns >= REPEAT_NS:
            if sends and action == "arm" and state.gate == GATE_FAULT:
                return False
            requests.send(action)
            sends, sent_ns = sends + 1, time.monotonic_ns()
        time.sleep(POLL_S)
    return False
