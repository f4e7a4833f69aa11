"""How a process keeps time with the others. Its loop reads the same at every pace: it waits on its inputs and on its clock.

At wall pace all look at one clock and nobody waits for anybody: each method hands back what it was given. At lockstep pace
(`softloop.wire.lockstep`) the same calls wait for what rig time says must come first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from softloop.wire.can_frame import CanFrame
from softloop.wire.clock import Clock, WallClock
from softloop.wire.messages import constant
from softloop.wire.session import Inbox

WIRE_DRIVER, WIRE_ANALOG, WIRE_INCLINOMETER = (constant("Tick", f"WIRE_{w}") for w in ("DRIVER", "ANALOG", "INCLINOMETER"))


class FrameSource(Protocol):
    """Where frames come from: a `CanPort`."""

    def recv(self, timeout_s: float = 0.0) -> CanFrame | None: ...


class ByteSource(Protocol):
    """Where bytes come from: a serial port."""

    def read(self, timeout_s: float) -> bytes: ...


class Queue(Protocol):
    """Where messages come from, each once: an `Inbox`."""

    def take(self, timeout_s: float = 0.0) -> tuple[str, bytes] | None: ...

    def take_all(self) -> list[tuple[str, bytes]]: ...


class Requests(Protocol):
    """Where requests come from, each once: an `Inbox`."""

    def take_all(self) -> list[tuple[str, bytes]]: ...


class Newest(Protocol):
    """Where the newest message comes from: a `Latest`."""

    def take(self) -> bytes | None: ...


class Pace:
    """Wall pace, and what the others have to offer too.

    Attributes:
        clock: the rig clock.
        exact: equal runs give equal bytes, so what differs from run to run (a pid, how busy the machine is) stays unsaid.
    """

    exact = False

    def __init__(self, clock: Clock | None = None) -> None:
        """`clock`: the machine's monotonic one unless given."""
        self.clock: Clock = clock or WallClock()

    def begin(self) -> None:
        """All inputs are declared: wait until everybody's are."""

    def finish(self) -> None:
        """The process does no more."""

    def frames(self, source: FrameSource, wire: int) -> FrameSource:
        """The frames of one of the rig's wires (WIRE_*)."""
        return source

    def valve_frames(self, source: FrameSource, frame_ns: int) -> FrameSource:
        """The plant's end of the valve wire, on which a frame stands for `frame_ns`."""
        return source

    def bytes(self, source: ByteSource, wire: int) -> ByteSource:
        """The bytes of one of the rig's wires, in the pieces in which they come."""
        return source

    def commands(self, source: Queue) -> Queue:
        """The controller's commands."""
        return source

    def requests(self, source: Inbox) -> Requests:
        """What persons ask of the gate, when it is due."""
        return source

    def newest(self, source: Newest, process: str, lag: int = 0) -> Newest:
        """An input of the controller; at lockstep that of the tick, or of `lag` ticks before, by `process`."""
        return source

    def hear_out(self, process: str, lag: int = 0) -> None:
        """At lockstep: the clock's sleep ends once all that `process` said on the tick is here; nobody waits for this one."""

    def note_sent(self, stamp_ns: int) -> None:
        """The gate has put a valve frame on the bus."""

    def note_piece(self, wire: int, amount: int, arrival_ns: int) -> None:
        """The plant has sent so many frames or bytes on a wire, whose last bit arrives at `arrival_ns`."""

    def keep_up(self, take: Callable[[], object]) -> None:
        """For a process that only listens: `take` all that has come; the others do not run far ahead of it."""
        take()

    def lateness_ns(self, due_ns: int) -> int:
        """By how much the clock is past `due_ns`; 0 where nothing can be late."""
        return max(0, self.clock.now_ns() - due_ns)
