"""Asking the gate to arm, disarm or stop, until it says what it did."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from typing import Literal

from softloop.deploy.bench import Bench
from softloop.deploy.rig_state import GATE_ARMED, GATE_DISARMED, GATE_FAULT, GATES, RigState
from softloop.wire.channels import ARM, REQUEST
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK, Unavailable
from softloop.wire.messages import constant, message
from softloop.wire.session import Wire, open_wire

Action = Literal["arm", "disarm", "stop"]
WANTED = {"arm": GATE_ARMED, "disarm": GATE_DISARMED, "stop": GATE_FAULT}
# A request can be lost (nothing on the wires waits), so it is said again until the gate is where it should be.
REPEAT_NS = 200_000_000
POLL_S = 0.02
ANEW_S = 0.7
FIND_GATE_S = 3.0  # a gate speaks every 5 ms; joining takes well under a second


class Requests:
    """One requester: its random name on the wire, and its count on each of the two channels."""

    def __init__(self, wire: Wire, origin: int = 0) -> None:
        """`origin`: a number of its own, not 0; random unless given."""
        self._wire = wire
        self._puts = {channel.name: wire.publisher(channel) for channel in (REQUEST, ARM) if wire.may_put(channel)}
        self._origin = origin or secrets.randbits(63)
        self._seqs = {REQUEST.name: 0, ARM.name: 0}

    def send(self, action: Action, stamp_ns: int | None = None) -> None:
        """Publish one request.

        Args:
            action: what is asked.
            stamp_ns: to arm: the stamp of the gate's newest word, which this request answers; at lockstep pace: when the request
                is to hold; else now.

        Raises Unavailable when this requester has no right to it.
        """
        channel = ARM if action == "arm" else REQUEST
        if channel.name not in self._puts:
            raise self._wire.refused("publish on", channel)
        self._seqs[channel.name] += 1
        request = message("GateRequest")
        code = constant("GateRequest", f"ACTION_{action.upper()}")
        stamp_ns = time.monotonic_ns() if stamp_ns is None else stamp_ns
        made = request.make(seq=self._seqs[channel.name], stamp_ns=stamp_ns, origin=self._origin, action=code)
        self._puts[channel.name](request.pack(made))


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
            requests.send(action, state.gate_stamp_ns if action == "arm" else None)
            sends, sent_ns = sends + 1, time.monotonic_ns()
        time.sleep(POLL_S)
    return False


def request_once(bench: Bench, action: Action, timeout_s: float) -> int:
    """`softloop request`: ask, and print the gate's answer; returns the exit code.

    Raises:
        Unavailable: no gate is running on this bench.
    """
    with open_wire(bench.zenoh, bench.name, f"request-{action}") as wire:
        requests = Requests(wire)
        state = _find_gate(bench, wire, min(timeout_s, FIND_GATE_S))
        obeyed = ask(requests, state, action, timeout_s)
    said = f"gate {GATES.get(state.gate or 0, '?')}" + ("" if state.reason == "none" else f" ({state.reason})")
    print(said if obeyed else f"refused: {said}", flush=True)
    return EXIT_OK if obeyed else EXIT_NEGATIVE


def _find_gate(bench: Bench, wire: Wire, timeout_s: float) -> RigState:
    """What is heard, once the gate is. Listens anew now and then: what is declared while a link comes up can be lost on it."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        state = RigState(wire)
        anew = min(deadline, time.monotonic() + ANEW_S)
        while state.gate is None and time.monotonic() < anew:
            time.sleep(POLL_S)
            state.refresh()
        if state.gate is not None:
            return state
    where = bench.zenoh.meeting_point(bench.name)
    raise Unavailable(f"no gate of bench '{bench.name}' is heard at {where}; is it running?")
