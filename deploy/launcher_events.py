"""The launcher's own events: a process that it lost, one that is back, and what it did to one because the bench file asked."""

from __future__ import annotations

from softloop.deploy.node import PROCESSES
from softloop.wire.channels import EVENT
from softloop.wire.clock import Clock, WallClock
from softloop.wire.messages import constant, message
from softloop.wire.session import Wire

_EVENT = message("Event")
_SOURCE = constant("Event", "SOURCE_LAUNCHER")
_PROCESS, _FAULT = constant("Event", "KIND_PROCESS"), constant("Event", "KIND_FAULT")
_SOURCE_HOST = constant("Event", "SOURCE_HOST")
_CLOCK, _ROUTER, _HOST = (constant("Event", f"KIND_{kind}") for kind in ("CLOCK", "ROUTER", "HOST"))
SOURCES = {process.name: constant("Event", process.source) for process in PROCESSES}


class LauncherEvents:
    """Publishes them, counted. Stamps are of the rig clock at wall pace: with one host, the machine's."""

    def __init__(self, wire: Wire, clock: Clock | None = None, follower: int | None = None) -> None:
        """`follower`: the place of this host among the bench's, where it does not lead."""
        self._put = wire.publisher(EVENT)
        self._clock = clock or WallClock()
        self._source = _SOURCE if follower is None else _SOURCE_HOST + follower
        self._seq = 0

    def process(self, name: str, back: bool, seconds: float) -> None:
        """Process `name` was lost, or is back after so many `seconds`. A lost recorder cannot hear the former."""
        self._say(_PROCESS, int(back), SOURCES.get(name, 0), seconds)

    def clock(self, code: int, host: int, value: float) -> None:
        """Something happened to a host's clock (CLOCK_*)."""
        self._say(_CLOCK, code, host, value)

    def router(self, back: bool, seconds: float) -> None:
        """The shared meeting point was lost, or is back after so many `seconds`. Nobody behind it hears the former."""
        self._say(_ROUTER, int(back), 0, seconds)

    def host(self, number: int, back: bool, seconds: float) -> None:
        """A host is not heard any more, or is again after so many `seconds`."""
        self._say(_HOST, int(back), number, seconds)

    def fault(self, reason: int, code: int, stamp_ns: int | None = None) -> None:
        """An injection (FAULT_*) began (1) or ended (0), now, or when nobody could be told of it."""
        self._say(_FAULT, code, reason, 0.0, stamp_ns)

    def _say(self, kind: int, code: int, reason: int, value: float, stamp_ns: int | None = None) -> None:
        self._seq += 1
        stamp_ns = self._clock.now_ns() if stamp_ns is None else stamp_ns
        event = _EVENT.make(
            seq=self._seq, stamp_ns=stamp_ns, source=self._source, kind=kind, code=code, reason=reason, value=value
        )
        self._put(_EVENT.pack(event))
