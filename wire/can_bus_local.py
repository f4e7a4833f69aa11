"""python-can's interface `emulated`: nodes of one process on a bus with a bit rate, arbitration and errors.

`can.Bus(interface="emulated", channel="a", bitrate=500_000)` joins the bus called `a` of this process, or makes it. What a node
sees is what the driver of a real controller sees on `socketcan`: frames at their end, and error frames of the same form. `send`
raises python-can's error with ENOBUFS when the queue is full, and with ENETDOWN once the node is off the bus.
"""

from __future__ import annotations

import errno
import itertools
import threading
import time
from collections import deque
from typing import Any

import can

from softloop.wire.can_bus import CanBus
from softloop.wire.can_errors import NodeState
from softloop.wire.can_frame import from_message, to_message
from softloop.wire.clock import Clock, WallClock

_LOOK_S = 0.0005
_LOCK = threading.RLock()
_BUSES: dict[str, _Shared] = {}


class _Shared:
    """One bus of this process; the lock is held by whoever moves it."""

    def __init__(self, bus: CanBus, clock: Clock) -> None:
        self.bus, self.clock = bus, clock
        self.inboxes: dict[int, deque[tuple[can.Message, bool]]] = {}

    def move(self, channel: str) -> None:
        for delivery in self.bus.run_until(self.clock.now_ns()):
            inbox = self.inboxes.get(delivery.node)
            if inbox is not None:
                frame = delivery.frame._replace(stamp_ns=delivery.end_ns)
                inbox.append((to_message(frame, channel, is_rx=not delivery.own), delivery.own))


_NODES = itertools.count(1)


class EmulatedBus(can.BusABC):
    """A node of an emulated bus.

    Args:
        channel: name of the bus.
        bitrate, error_rate, restart_ms, seed: of the bus, as its first node gives them.
        receive_own_messages: also receive what this node sent, once it is out.
        tx_queue: frames that wait for the bus at most.
        clock: the rig's clock.
    """

    def __init__(
        self,
        channel: Any = "can0",
        can_filters: Any = None,
        *,
        bitrate: int = 500_000,
        error_rate: float = 0.0,
        restart_ms: float = 0.0,
        receive_own_messages: bool = False,
        tx_queue: int = 64,
        seed: int = 1,
        clock: Clock | None = None,
        **_ignored: Any,
    ) -> None:
        self._channel, self._own, self._node = str(channel), receive_own_messages, next(_NODES)
        with _LOCK:
            if self._channel not in _BUSES:
                made = CanBus(bitrate, error_rate=error_rate, restart_ns=round(restart_ms * 1e6), queue=tx_queue, seed=seed)
                _BUSES[self._channel] = _Shared(made, clock or WallClock())
            self._shared = _BUSES[self._channel]
            self._shared.bus.join(self._node)
            self._inbox = self._shared.inboxes[self._node] = deque()
        self._seq = itertools.count(1)
        self.channel_info = f"emulated: {self._channel}"
        super().__init__(self._channel, can_filters=can_filters)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        end = None if timeout is None else time.monotonic() + timeout
        while True:
            with _LOCK:
                self._shared.move(self._channel)
                while self._inbox:
                    message, own = self._inbox.popleft()
                    if self._own or not own:
                        return message, False
            if end is not None and time.monotonic() >= end:
                return None, False
            time.sleep(_LOOK_S)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Queue a frame. Raises CanOperationError: ENOBUFS when the queue is full, ENETDOWN when the node is off the bus."""
        end = time.monotonic() + (timeout or 0.0)
        while True:
            with _LOCK:
                now_ns = self._shared.clock.now_ns()
                self._shared.move(self._channel)
                if self._shared.bus.state(self._node) == NodeState.BUS_OFF:
                    raise can.CanOperationError("the node is off the bus", errno.ENETDOWN)
                if self._shared.bus.send(self._node, from_message(msg, next(self._seq), now_ns, self._node), now_ns):
                    return
            if time.monotonic() >= end:
                raise can.CanOperationError("the transmit queue is full", errno.ENOBUFS)
            time.sleep(_LOOK_S)

    def _apply_filters(self, filters: Any) -> None:
        """python-can filters what `_recv_internal` gives."""

    @property
    def emulation(self) -> CanBus:
        """The bus itself: its load, counters and faults."""
        return self._shared.bus

    @property
    def node(self) -> int:
        return self._node

    def load(self) -> float:
        """Share of the last second in which the bus was busy."""
        with _LOCK:
            self._shared.move(self._channel)
            return self._shared.bus.load(self._shared.clock.now_ns())

    def restart(self) -> None:
        """Begin to come back after bus-off."""
        with _LOCK:
            self._shared.bus.restart(self._node, self._shared.clock.now_ns())

    def shutdown(self) -> None:
        super().shutdown()
        with _LOCK:
            self._shared.bus.leave(self._node)
            self._shared.inboxes.pop(self._node, None)
            if not self._shared.inboxes:
                _BUSES.pop(self._channel, None)
