"""What a process reads at lockstep pace: the same calls as at wall pace, each giving what rig time says, when it says so."""

from __future__ import annotations

import time
from math import ceil
from typing import TYPE_CHECKING

from softloop.wire.can_frame import CanFrame
from softloop.wire.errors import Lost
from softloop.wire.messages import BadPayload, constant, message
from softloop.wire.pace import ByteSource, FrameSource, Newest, Queue
from softloop.wire.session import Inbox

if TYPE_CHECKING:
    from softloop.wire.lockstep import Follower, Leader

_REQUEST = message("GateRequest")
_STOP = constant("GateRequest", "ACTION_STOP")
_POLL_S = 1e-4
_LOOK_S = 0.05
_CONTROLLER = "controller"


class PacedValveFrames:
    """The valve frames that the gate says it has sent, each taken at its end on the wire; then the clock goes on to the tick."""

    def __init__(self, pace: Leader, source: FrameSource, frame_ns: int) -> None:
        self._pace, self._source, self._frame_ns, self._taken = pace, source, frame_ns, 0

    def recv(self, timeout_s: float = 0.0) -> CanFrame | None:
        pace = self._pace
        mark = pace.board.marks.get("valves")
        if mark is None or self._taken >= mark.sent or pace.interrupted():
            pace.rig_clock.set(pace.target_ns)
            return None
        self._taken += 1
        pace.rig_clock.set(mark.sent_stamp_ns + self._frame_ns)
        end_s = time.monotonic() + pace.timeout_s
        while (frame := self._source.recv(_LOOK_S)) is None:
            if pace.interrupted() or time.monotonic() >= end_s:
                raise Lost("lockstep: a valve frame that the gate has sent does not arrive")
        return frame


class PacedFrames:
    """The announced frames of a wire, each at its arrival. Who waits for one (`timeout_s` above 0) goes on from tick to tick."""

    def __init__(self, pace: Follower, source: FrameSource, wire: int) -> None:
        self._pace, self._source, self._pieces = pace, source, pace.pieces_of(wire)

    def recv(self, timeout_s: float = 0.0) -> CanFrame | None:
        pace = self._pace
        if not self._pieces and (timeout_s <= 0 or not pace.next_tick() or not self._pieces):
            return None
        _, arrival_ns = self._pieces.popleft()
        pace.rig_clock.set(arrival_ns)
        frame: CanFrame | None = pace.awaited(self._source.recv, "a CAN frame that the plant has sent")
        return frame


class PacedBytes:
    """The announced bytes of a wire, one piece at a time, each at its arrival."""

    def __init__(self, pace: Follower, source: ByteSource, wire: int) -> None:
        self._pace, self._source, self._pieces = pace, source, pace.pieces_of(wire)
        self._taken, self._ahead = 0, b""

    def read(self, timeout_s: float) -> bytes:
        pace = self._pace
        if not self._pieces and (not pace.next_tick() or not self._pieces):
            return b""
        end, arrival_ns = self._pieces.popleft()
        pace.rig_clock.set(arrival_ns)
        wanted = end - self._taken
        while len(self._ahead) < wanted:
            more = pace.awaited(lambda left_s: self._source.read(left_s) or None, "what the inclinometer has sent")
            if more is None:
                return b""
            self._ahead += more
        piece, self._ahead = self._ahead[:wanted], self._ahead[wanted:]
        self._taken = end
        return piece


class PacedCommands:
    """The controller's command of each tick, taken the software's latency after it; the gate goes on from tick to tick here."""

    def __init__(self, pace: Follower, source: Queue) -> None:
        self._pace, self._source, self._last = pace, source, 0

    def take(self, timeout_s: float = 0.0) -> tuple[str, bytes] | None:
        pace = self._pace
        until_ns = pace.clock.now_ns() + ceil(timeout_s * 1e9)
        if not pace.next_tick() or not pace.board.wait_done(_CONTROLLER, int(pace.tick.tick) + 1):
            return None
        pace.end_with_this()
        pace.rig_clock.set(pace.tick.stamp_ns + pace.latency_ns)
        seq = int(pace.board.marks[_CONTROLLER].last_seq)
        if seq <= self._last:  # nothing came on this tick: the caller's deadline passes, where it lies before the next one
            if until_ns < pace.tick.stamp_ns + pace.period_ns:
                pace.rig_clock.set(until_ns)
            return None
        self._last = seq
        command: tuple[str, bytes] | None = pace.awaited(self._source.take, f"command {seq} of the controller")
        return command

    def take_all(self) -> list[tuple[str, bytes]]:
        return []


class PacedRequests:
    """Requests take effect at their stamp, so that a run can be planned; an emergency stop at once."""

    def __init__(self, pace: Follower, source: Inbox) -> None:
        self._pace, self._source = pace, source
        self._waiting: list[tuple[int, tuple[str, bytes]]] = []
        pace.requests_in = lambda: source.received

    def take_all(self) -> list[tuple[str, bytes]]:
        self._waiting.extend((_due_ns(item[1]), item) for item in self._source.take_all())
        now_ns = self._pace.clock.now_ns()
        due = [item for due_ns, item in self._waiting if due_ns <= now_ns]
        self._waiting = [entry for entry in self._waiting if entry[0] > now_ns]
        return due


def _due_ns(payload: bytes) -> int:
    try:
        request = _REQUEST.unpack(payload)
    except BadPayload:
        return 0  # whoever takes it says what is wrong with it
    return 0 if request.action == _STOP else int(request.stamp_ns)


def seq_of(payload: bytes) -> int:
    """Every message begins, behind the CDR header, with its number."""
    return int.from_bytes(payload[4:12], "little")


class PacedNewest:
    """The message that a process's watermark names."""

    def __init__(self, pace: Follower, source: Newest, process: str) -> None:
        self._pace, self._source, self._process, self._last = pace, source, process, 0

    def take(self) -> bytes | None:
        mark = self._pace.board.marks.get(self._process)
        if mark is None or mark.last_seq <= self._last:
            return None
        self._last = int(mark.last_seq)
        payload: bytes | None = self._pace.awaited(self._look, f"message {self._last} of '{self._process}'")
        return payload

    def _look(self, _timeout_s: float) -> bytes | None:
        payload = self._source.take()
        if payload is not None and seq_of(payload) >= self._last:
            return payload
        time.sleep(_POLL_S)
        return None
