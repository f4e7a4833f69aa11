"""An emulated CAN bus among processes: the end of the one who holds it.

Nodes in other processes hand their frames to it (`ZenohBus` with `through_bus`); nodes of this process do so by `send`. All go
through one `CanBus`, and what that carries is published at its end, stamped with it, for everybody on the channel. What a
node's controller has to say to its driver alone, a new error state, is an error frame under `controller_of` that node.

Whoever holds a bus tells it the time: `run_until`, again and again. Frames that come late over Zenoh get on the bus as if they
had been there at their stamps, behind what has gone out meanwhile.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

import zenoh

from softloop.wire.can_bus import CanBus, Delivery
from softloop.wire.can_config import CanConfig, EmulationConfig
from softloop.wire.can_errors import ERROR_BUS
from softloop.wire.can_frame import FLAG_ERROR, FRAME_SIZE, CanFrame, controller_of, unpack_frame
from softloop.wire.can_queue import FrameQueue
from softloop.wire.can_zenoh import FramePublisher, answer_to, name_key
from softloop.wire.channels import BUS_ROOT, bus_key, can_key, node_of
from softloop.wire.messages import message
from softloop.wire.session import Wire

_STATUS = message("CanBusStatus")
NODES = 8
_INBOX = 4096
_MOST_NODES = 64
_HIGHEST_COUNT = 255
FOREVER_NS = 1 << 62


class BusOwner:
    """Holds one channel's bus.

    Attributes:
        bus: the bus itself.
        nodes: name -> number on the bus, of the nodes there are from the start.
        malformed: what came on the nodes' keys and was no frame.
    """

    def __init__(self, config: CanConfig, wire: Wire, names: Collection[str]) -> None:
        """`names`: nodes there are from the start; whoever else sends joins with its first frame."""
        given = config.emulation or EmulationConfig()
        self._channel = str(config.channel)
        self.bus = CanBus(
            config.bitrate, error_rate=given.error_rate, restart_ns=round(given.restart_ms * 1e6), queue=given.queue_frames,
            seed=given.seed,
        )  # fmt: skip
        self.nodes: dict[str, int] = {name: node_of(wire.bench, name, self._channel) for name in names}
        self._places = list(self.nodes.values())
        for node in self._places:
            self.bus.join(node)
        self._bus_errors = given.bus_errors
        self._said: dict[int, int] = {}
        self.malformed = 0
        self._bench = wire.bench
        self._inbox = FrameQueue(_INBOX)
        self._publisher = FramePublisher(wire.session, wire.bench, self._channel, wire.congestion, can_key)
        handler = zenoh.handlers.Callback(self._receive, indirect=False)
        subscriber = wire.session.declare_subscriber(f"{BUS_ROOT}/{wire.bench}/{self._channel}/*", handler)
        self._declared = (subscriber, answer_to(wire.session, name_key(wire.bench, self._channel, 0)))

    # Runs in Zenoh's receiving thread: short, and never raises.
    def _receive(self, sample: zenoh.Sample) -> None:
        payload = sample.payload
        frame = unpack_frame(payload.to_bytes()) if len(payload) == FRAME_SIZE else None
        if frame is None or str(sample.key_expr) != bus_key(self._bench, self._channel, frame.arbitration_id):
            self.malformed += 1
        elif not frame.flags & FLAG_ERROR:
            self._inbox.put(frame)

    def recv(self, timeout_s: float = 0.0) -> CanFrame | None:
        """The next frame that a node of another process has handed over; it is not on the bus before `send`."""
        return self._inbox.take(timeout_s)

    def send(self, frame: CanFrame, at_ns: int, *, mailbox: bool = False) -> bool:
        """Let the frame's node have it to send from `at_ns` on; False when its queue is full, or it is off the bus.

        `mailbox`: as `CanBus.send` has it.
        """
        if frame.node not in self._places:
            if len(self._places) >= _MOST_NODES:  # strangers must not eat the memory
                self.malformed += 1
                return False
            self.bus.join(frame.node)
            self._places.append(frame.node)
        return self.bus.send(frame.node, frame, at_ns, mailbox=mailbox)

    def next_ns(self) -> int:
        """When the next thing on the bus is over, as far as is known."""
        at_ns = self.bus.next_end_ns()
        return FOREVER_NS if at_ns is None else at_ns

    def run_until(self, now_ns: int) -> list[Delivery]:
        """Let all happen that ends by `now_ns`, publish it, and give what each node got of it."""
        found = []
        for delivery in self.bus.run_until(now_ns):
            frame = delivery.frame._replace(stamp_ns=delivery.end_ns)
            if frame.flags & FLAG_ERROR:
                if frame.arbitration_id & ERROR_BUS and not self._bus_errors:
                    continue
                self._said[delivery.node] = seq = self._said.get(delivery.node, 0) + 1
                frame = frame._replace(node=controller_of(delivery.node), seq=seq)
            if delivery.own or frame.flags & FLAG_ERROR:
                self._publisher.put(frame)
            found.append(delivery._replace(frame=frame))
        return found

    def status(self, now_ns: int) -> Mapping[str, Any]:
        """The fields of a `CanBusStatus`, but for `seq` and `bus`."""
        bus = self.bus
        shown = self._places[:NODES]
        counters = [bus.counters(node) for node in shown]
        waited_max_ns, bus.waited_max_ns = bus.waited_max_ns, 0
        return {
            "stamp_ns": now_ns, "load": bus.load(now_ns), "bitrate": bus.bitrate, "frames": bus.frames,
            "disturbed": bus.disturbed, "unacknowledged": bus.unacknowledged, "refused": bus.refused,
            "waited_max_ns": waited_max_ns, "node": _filled(shown), "nodes": len(shown),
            "transmit_errors": _filled([min(one, _HIGHEST_COUNT) for one, _ in counters]),
            "receive_errors": _filled([min(one, _HIGHEST_COUNT) for _, one in counters]),
            "state": _filled([int(bus.state(node)) for node in shown]),
        }  # fmt: skip

    def close(self) -> None:
        """Let go of the channel."""
        self._publisher.close()
        self._inbox.close()
        for declared in self._declared:
            declared.undeclare()


def _filled(values: list[int]) -> list[int]:
    return values + [0] * (NODES - len(values))
