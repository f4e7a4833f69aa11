"""The rig's devices as nodes of an emulated CAN bus (`[can.NAME.emulation]`), which the plant holds.

A frame is handed to its node's controller when on a pipe it would have begun; the bus says when it has got through, and with it
what comes of the commands. The gate and the pressure adapter are nodes too, in their own processes, and cannot tell.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import count

from softloop.devices.protocols.can_frames import ANALOG_INPUTS_ID, DLC, VALVE_COMMAND_ID, VALVE_STATUS_ID
from softloop.devices.protocols.wire_time import can_frame_ns
from softloop.wire.can_bits import frame_bits
from softloop.wire.can_bus import Delivery
from softloop.wire.can_config import CanConfig
from softloop.wire.can_frame import FLAG_ERROR, CanFrame, make_frame
from softloop.wire.can_owner import FOREVER_NS, BusOwner
from softloop.wire.channels import CAN_BUS
from softloop.wire.fault_line import Strike
from softloop.wire.messages import message
from softloop.wire.pace import WIRE_ANALOG, WIRE_DRIVER, Pace
from softloop.wire.shell import Context

# In the order of CanBusStatus NODE_*: the devices, then the processes by their names.
NAMES = DRIVER, ANALOG, GATE, PRESSURES = "driver", "analog", "valves", "pressures"
_SENDERS = {VALVE_STATUS_ID: DRIVER, ANALOG_INPUTS_ID: ANALOG}
_TARGETS = {VALVE_COMMAND_ID: "command", VALVE_STATUS_ID: "driver", ANALOG_INPUTS_ID: "analog"}
_HEARERS = {GATE: (WIRE_DRIVER, VALVE_STATUS_ID), PRESSURES: (WIRE_ANALOG, ANALOG_INPUTS_ID)}
_BABBLE = {"first": 0x000, "last": 0x7FF}  # before all others in arbitration, and behind all
_BABBLER = 1  # its node
STATUS_NS = 100_000_000
_STATUS = message("CanBusStatus")


@dataclass
class _Babbler:
    """A node that sends without end while its injection stands, and what it sends."""

    strike: Strike
    frame: CanFrame
    next_ns: int = 0


class BusEnd:
    """One emulated bus with the devices that are on it."""

    def __init__(self, config: CanConfig, context: Context) -> None:
        self._owner = BusOwner(config, context.wire, NAMES)
        self._numbers = {name: count(1) for name in (DRIVER, ANALOG)}
        self._frame_ns = can_frame_ns(DLC, config.bitrate)
        self._pace: Pace = context.pace
        self._strikes: Mapping[int, list[Strike]] = {i: context.faults.of("bus", name) for i, name in _TARGETS.items()}
        if any(self._strikes.values()):
            self._owner.bus.disturbs = self._disturbs
        self._babblers = [
            _Babbler(strike, make_frame(1, 0, _BABBLER, arbitration_id, bytes([0x55] * DLC)))
            for target, arbitration_id in _BABBLE.items()
            for strike in context.faults.of("bus", target)
        ]
        self.commands = context.pace.valve_frames(self._owner, 0)

    def _disturbs(self, frame: CanFrame, start_ns: int) -> bool:
        hit = [strike.hits(start_ns) for strike in self._strikes.get(frame.arbitration_id, ())]  # each has chances of its own
        return any(hit)

    def take(self, now_ns: int) -> None:
        """Take what nodes in other processes have handed over."""
        while (frame := self.commands.recv(0.0)) is not None:
            self._owner.send(frame, min(frame.stamp_ns, now_ns) if now_ns else frame.stamp_ns)

    def hand_over(self, arbitration_id: int, data: bytes, end_ns: int) -> None:
        """Let a device send a frame that on an idle bus would be over at `end_ns` at the latest."""
        name, at_ns = _SENDERS[arbitration_id], end_ns - self._frame_ns
        node = self._owner.nodes[name]
        frame = make_frame(next(self._numbers[name]), at_ns, node, arbitration_id, data)
        self._owner.send(frame, at_ns, mailbox=True)

    @property
    def next_ns(self) -> int:
        """When the next thing on the bus is over."""
        return self._owner.next_ns()

    def run_until(self, now_ns: int) -> list[CanFrame]:
        """Let all happen that ends by then; gives the frames that have reached the valve driver, each stamped with its end."""
        reached = []
        self._babble(now_ns)
        for delivery in self._owner.run_until(now_ns):
            self._announce(delivery)
            if delivery.node == self._owner.nodes[DRIVER] and not delivery.own and not delivery.frame.flags & FLAG_ERROR:
                reached.append(delivery.frame)
        return reached

    def _babble(self, now_ns: int) -> None:
        """Let a node that has gone mad have a frame ready whenever the last one could be over."""
        for one in self._babblers:
            one.next_ns = one.next_ns or now_ns
            while one.next_ns < now_ns:
                if one.strike.on(one.next_ns):
                    one.frame = one.frame._replace(seq=one.frame.seq + 1, stamp_ns=one.next_ns)
                    self._owner.send(one.frame, one.next_ns)
                one.next_ns += self._owner.bus.bits_ns(frame_bits(one.frame))

    def _announce(self, delivery: Delivery) -> None:
        """Tell the pace of what an adapter is to take."""
        for name, (wire, arbitration_id) in _HEARERS.items():
            told = delivery.frame.flags & FLAG_ERROR or delivery.frame.arbitration_id == arbitration_id
            if delivery.node == self._owner.nodes[name] and told and not delivery.own:
                self._pace.note_piece(wire, 1, delivery.end_ns)

    def status(self, now_ns: int, seq: int, bus: int) -> bytes:
        """Its `CanBusStatus`; `bus` is its place among the plant's."""
        return _STATUS.pack(_STATUS.make(seq=seq, bus=bus, **self._owner.status(now_ns)))

    def close(self) -> None:
        self._owner.close()


class BusEnds:
    """All emulated buses of the plant, and what it says of them."""

    def __init__(self, ends: list[BusEnd], context: Context) -> None:
        self.all = ends
        self._put = context.wire.publisher(CAN_BUS) if ends else None
        self._seq, self._due_ns = 0, 0

    @property
    def next_ns(self) -> int:
        """When the next thing on any of them is over."""
        return min((end.next_ns for end in self.all), default=FOREVER_NS)

    def tell(self, now_ns: int) -> None:
        """Publish how they are, ten times a second."""
        if self._put is None or now_ns < self._due_ns:
            return
        self._due_ns = max(self._due_ns + STATUS_NS, now_ns)
        for place, end in enumerate(self.all):
            self._seq += 1
            self._put(end.status(now_ns, self._seq, place))

    def close(self) -> None:
        for end in self.all:
            end.close()
