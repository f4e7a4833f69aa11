"""A CAN bus in time: bit rate, exact frame length, arbitration, errors, bus-off and recovery, load. It is told what time it is.

Each node has a queue of frames to send, first in first out, as a controller without reordering has. When the bus is free, the
heads of the queues that are there arbitrate, and the frame that ranks first goes out; the others wait and try again. A frame that
is disturbed, or that nobody acknowledges, is sent again, as controllers do. Errors are put in by `disturb`, or by chance with a
rate per frame; chance is of a seed, so that the same frames give the same run.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from softloop.wire.can_bits import ERROR_FRAME_BITS, arbitration_rank, frame_bits
from softloop.wire.can_errors import RECOVERY_BITS, ErrorCounters, NodeState, bus_error_frame, state_frame
from softloop.wire.can_frame import CanFrame

SUSPEND_BITS = 8  # a passive node waits so much longer after a frame of its own
LOAD_WINDOW_NS = 1_000_000_000
NS = 1_000_000_000


class Delivery(NamedTuple):
    """What a node's controller hands to its driver at `end_ns`: a frame of another node, its own, or an error frame."""

    end_ns: int
    node: int
    frame: CanFrame
    own: bool


class _Waiting(NamedTuple):
    """A frame in its node's queue: since when, and how long it will stand on the bus."""

    since_ns: int
    frame: CanFrame
    bits: int


@dataclass
class _Node:
    counters: ErrorCounters = field(default_factory=ErrorCounters)
    waiting: deque[_Waiting] = field(default_factory=deque)
    may_send_ns: int = 0
    recovers_ns: int = 0  # 0: not on its way back
    said: NodeState = NodeState.ACTIVE
    errors_said: int = 0


class CanBus:
    """One bus and its nodes.

    Attributes:
        frames, disturbed, unacknowledged, refused: how often each happened, in total; refused frames found their node's
            queue full, or the node off the bus.
        waited_max_ns: the longest that a frame which got out had waited for its turn; whoever reads it sets it back.
        disturbs: asked of each transmission (frame, its start) whether something destroys it.
    """

    def __init__(self, bitrate: int, *, error_rate: float = 0.0, restart_ns: int = 0, queue: int = 64, seed: int = 1) -> None:
        """`restart_ns`: a node that went off the bus begins to come back by itself so much later; 0: only by `restart`."""
        self.bitrate = bitrate
        self._error_rate, self._restart_ns, self._queue = error_rate, restart_ns, queue
        self._chance = random.Random(seed)
        self._nodes: dict[int, _Node] = {}
        self._free_ns = 0
        self._to_disturb = 0
        self._busy: deque[tuple[int, int]] = deque()
        self.frames = self.disturbed = self.unacknowledged = self.refused = self.waited_max_ns = 0
        self.disturbs: Callable[[CanFrame, int], bool] = lambda frame, start_ns: False

    def bits_ns(self, bits: int) -> int:
        return bits * NS // self.bitrate

    def join(self, node: int) -> None:
        self._nodes.setdefault(node, _Node())

    def leave(self, node: int) -> None:
        self._nodes.pop(node, None)

    def state(self, node: int) -> NodeState:
        return self._nodes[node].counters.state

    def counters(self, node: int) -> tuple[int, int]:
        """Transmit and receive error counter of a node."""
        of_node = self._nodes[node].counters
        return of_node.transmit, of_node.receive

    def send(self, node: int, frame: CanFrame, now_ns: int, *, mailbox: bool = False) -> bool:
        """Put a frame into a node's queue; False when it is full, or the node is off the bus.

        `now_ns` may be ahead of what `run_until` was told, and behind it: then the frame is as late for the bus as it came.
        With `mailbox` it takes the place of one with its identifier that still waits, as devices that send in cycles do.
        """
        own = self._nodes[node]
        if own.counters.off or len(own.waiting) >= self._queue:
            self.refused += 1
            return False
        same = mailbox and own.waiting and own.waiting[-1].frame.arbitration_id == frame.arbitration_id
        if same and (len(own.waiting) > 1 or not self._may_be_under_way(node, now_ns)):
            own.waiting.pop()
        own.waiting.append(_Waiting(now_ns, frame, frame_bits(frame)))
        return True

    def _may_be_under_way(self, node: int, now_ns: int) -> bool:
        start_ns = self.next_ns()
        if start_ns is None or start_ns >= now_ns or self._returning(start_ns) is not None:
            return False
        return self._arbitrate(start_ns)[0] == node

    def disturb(self, frames: int = 1) -> None:
        """Disturb the next transmissions, whoever sends them."""
        self._to_disturb += frames

    def restart(self, node: int, now_ns: int) -> None:
        """Let a node that is off the bus come back, once it has seen enough recessive bits."""
        own = self._nodes[node]
        if own.counters.off and not own.recovers_ns:
            own.recovers_ns = now_ns + self.bits_ns(RECOVERY_BITS)

    def load(self, now_ns: int) -> float:
        """Share of the last second in which the bus was busy, frames under way and error frames included."""
        start = now_ns - LOAD_WINDOW_NS
        while self._busy and self._busy[0][1] <= start:
            self._busy.popleft()
        return sum(max(0, min(end, now_ns) - max(begin, start)) for begin, end in self._busy) / LOAD_WINDOW_NS

    def next_ns(self) -> int | None:
        """When the next frame may begin or a node comes back; None when nothing waits."""
        starts = [
            max(self._free_ns, n.may_send_ns, n.waiting[0].since_ns)
            for n in self._nodes.values()
            if n.waiting and not n.counters.off
        ]
        backs = [n.recovers_ns for n in self._nodes.values() if n.recovers_ns]
        return min(starts + backs, default=None)

    def next_end_ns(self) -> int | None:
        """When the next thing is over, as far as is known now: a frame, or a node's way back; None when nothing waits."""
        start_ns = self.next_ns()
        if start_ns is None or self._returning(start_ns) is not None:
            return start_ns
        return start_ns + self.bits_ns(self._arbitrate(start_ns)[1].bits)

    def run_until(self, now_ns: int) -> list[Delivery]:
        """Let all happen that ends at or before `now_ns`; what the nodes get, in the order of time."""
        found: list[Delivery] = []
        while (start_ns := self.next_ns()) is not None and start_ns <= now_ns:
            back = self._returning(start_ns)
            if back is not None:
                found += self._come_back(back, start_ns)
                continue
            sender, first = self._arbitrate(start_ns)
            end_ns = start_ns + self.bits_ns(first.bits)
            if end_ns > now_ns:
                break
            found += self._transmit(sender, first, start_ns, end_ns)
        return found

    def _returning(self, at_ns: int) -> int | None:
        return next((k for k, n in self._nodes.items() if n.recovers_ns and n.recovers_ns == at_ns), None)

    def _come_back(self, node: int, at_ns: int) -> list[Delivery]:
        own = self._nodes[node]
        own.recovers_ns, own.may_send_ns = 0, at_ns
        own.counters.recover()
        return self._say_state(node, at_ns)

    def _arbitrate(self, start_ns: int) -> tuple[int, _Waiting]:
        ready = [
            (arbitration_rank(n.waiting[0].frame), k)
            for k, n in self._nodes.items()
            if n.waiting and not n.counters.off and n.waiting[0].since_ns <= start_ns and n.may_send_ns <= start_ns
        ]
        node = min(ready)[1]
        return node, self._nodes[node].waiting[0]

    def _transmit(self, sender: int, first: _Waiting, start_ns: int, end_ns: int) -> list[Delivery]:
        frame = first.frame
        listeners = [k for k, n in self._nodes.items() if k != sender and not n.counters.off]
        disturbed = self._to_disturb > 0 or (self._error_rate > 0.0 and self._chance.random() < self._error_rate)
        disturbed = self.disturbs(frame, start_ns) or disturbed
        if disturbed:
            self._to_disturb = max(0, self._to_disturb - 1)
        if disturbed or not listeners:
            return self._fail(sender, listeners, start_ns, end_ns, acknowledge=not disturbed)
        self._occupy(start_ns, end_ns)
        own = self._nodes[sender]
        own.waiting.popleft()
        own.counters.sent()
        self._suspend(own, end_ns)
        self.frames += 1
        self.waited_max_ns = max(self.waited_max_ns, start_ns - first.since_ns)
        found = [Delivery(end_ns, sender, frame, own=True)]
        for k in listeners:
            self._nodes[k].counters.received()
            found.append(Delivery(end_ns, k, frame, own=False))
        for k in (sender, *listeners):
            found += self._say_state(k, end_ns)
        return found

    def _fail(self, sender: int, listeners: list[int], start_ns: int, end_ns: int, *, acknowledge: bool) -> list[Delivery]:
        """The frame is broken off by an error frame and stays in its queue."""
        end_ns += self.bits_ns(ERROR_FRAME_BITS)
        self._occupy(start_ns, end_ns)
        own = self._nodes[sender]
        self.unacknowledged += acknowledge
        self.disturbed += not acknowledge
        own.counters.send_failed(acknowledge=acknowledge)
        own.errors_said += 1
        said = bus_error_frame(own.counters, own.errors_said, end_ns, sender, acknowledge=acknowledge)
        found = [Delivery(end_ns, sender, said, own=False)]
        self._suspend(own, end_ns)
        for k in listeners:
            self._nodes[k].counters.receive_failed()
        for k in (sender, *listeners):
            found += self._say_state(k, end_ns)
        return found

    def _suspend(self, node: _Node, end_ns: int) -> None:
        passive = node.counters.state == NodeState.PASSIVE
        node.may_send_ns = end_ns + (self.bits_ns(SUSPEND_BITS) if passive else 0)

    def _say_state(self, node: int, at_ns: int) -> list[Delivery]:
        own = self._nodes[node]
        frame = state_frame(own.counters, own.said, own.errors_said + 1, at_ns, node)
        if frame is None:
            return []
        own.errors_said += 1
        own.said = own.counters.state
        if own.counters.off:
            own.waiting.clear()  # a controller that goes off loses what it had to send
            if self._restart_ns:
                own.recovers_ns = at_ns + self._restart_ns + self.bits_ns(RECOVERY_BITS)
        return [Delivery(at_ns, node, frame, own=False)]

    def _occupy(self, start_ns: int, end_ns: int) -> None:
        self._busy.append((start_ns, end_ns))
        self._free_ns = end_ns
