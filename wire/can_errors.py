"""A CAN node's error counters and states (ISO 11898-1), and error frames in SocketCAN's form."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from softloop.wire.can_frame import (
    CONTROLLER_ACTIVE,
    ERROR_BUS_OFF,
    ERROR_CONTROLLER,
    ERROR_RESTARTED,
    FLAG_ERROR,
    MAX_DLC,
    CanFrame,
    make_frame,
)

WARNING_AT, PASSIVE_AT, BUS_OFF_AT = 96, 128, 256
RECOVERY_BITS = 128 * 11  # as many recessive bits must a node that was off the bus have seen
ERROR_PROTOCOL = 0x008  # class bits of linux/can/error.h that `can_frame` does not need to read
ERROR_ACK = 0x020
ERROR_BUS = 0x080
PROTOCOL_BIT = 0x01  # data[2]
RX_WARNING, TX_WARNING, RX_PASSIVE, TX_PASSIVE = 0x04, 0x08, 0x10, 0x20  # data[1]
ERROR_COUNTERS = 0x200  # data[6] and data[7] hold the counters


class NodeState(IntEnum):
    """Error state of a node."""

    ACTIVE = 0
    WARNING = 1  # still active: the controller's own early word
    PASSIVE = 2
    BUS_OFF = 3


@dataclass
class ErrorCounters:
    """Transmit and receive error counters of one node, and the state that follows from them."""

    transmit: int = 0
    receive: int = 0
    off: bool = False

    @property
    def state(self) -> NodeState:
        if self.off:
            return NodeState.BUS_OFF
        worst = max(self.transmit, self.receive)
        if worst >= PASSIVE_AT:
            return NodeState.PASSIVE
        return NodeState.WARNING if worst >= WARNING_AT else NodeState.ACTIVE

    def sent(self) -> None:
        self.transmit = max(0, self.transmit - 1)

    def received(self) -> None:
        """One good frame; a passive receiver comes back to just under the limit."""
        if self.receive >= PASSIVE_AT:
            self.receive = PASSIVE_AT - 1
        else:
            self.receive = max(0, self.receive - 1)

    def send_failed(self, *, acknowledge: bool = False) -> None:
        """One error while sending. A passive node whose frame nobody acknowledges does not count on: it may be alone."""
        if acknowledge and self.transmit >= PASSIVE_AT:
            return
        self.transmit += 8
        self.off = self.off or self.transmit >= BUS_OFF_AT

    def receive_failed(self) -> None:
        self.receive = min(self.receive + 1, BUS_OFF_AT - 1)

    def recover(self) -> None:
        self.transmit = self.receive = 0
        self.off = False


def state_frame(counters: ErrorCounters, before: NodeState, seq: int, stamp_ns: int, node: int) -> CanFrame | None:
    """The error frame with which a controller tells its driver of a new state; None when it is the old one."""
    now = counters.state
    if now == before:
        return None
    if now == NodeState.BUS_OFF:
        return _frame(ERROR_BUS_OFF, 0, 0, counters, seq, stamp_ns, node)
    if before == NodeState.BUS_OFF:
        return _frame(ERROR_RESTARTED, 0, 0, counters, seq, stamp_ns, node)
    sending, receiving = counters.transmit >= counters.receive, counters.receive >= counters.transmit
    detail = CONTROLLER_ACTIVE
    if now == NodeState.PASSIVE:
        detail = TX_PASSIVE * sending | RX_PASSIVE * receiving
    elif now == NodeState.WARNING:
        detail = TX_WARNING * sending | RX_WARNING * receiving
    return _frame(ERROR_CONTROLLER, detail, 0, counters, seq, stamp_ns, node)


def bus_error_frame(counters: ErrorCounters, seq: int, stamp_ns: int, node: int, *, acknowledge: bool = False) -> CanFrame:
    """The error frame of one failed transmission: a bit error, or nobody who acknowledged."""
    if acknowledge:
        return _frame(ERROR_ACK | ERROR_BUS, 0, 0, counters, seq, stamp_ns, node)
    return _frame(ERROR_PROTOCOL | ERROR_BUS, 0, PROTOCOL_BIT, counters, seq, stamp_ns, node)


def _frame(classes: int, controller: int, protocol: int, counters: ErrorCounters, seq: int, stamp_ns: int, node: int) -> CanFrame:
    data = bytearray(MAX_DLC)
    data[1], data[2] = controller, protocol
    data[6], data[7] = min(counters.transmit, 255), min(counters.receive, 255)
    return make_frame(seq, stamp_ns, node, classes | ERROR_COUNTERS, bytes(data), FLAG_ERROR)
