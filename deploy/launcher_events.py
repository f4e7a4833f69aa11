"""The launcher's own events: a process that it lost, one that is back, and what it did to one because the bench file asked."""

from __future__ import annotations

import time

from softloop.deploy.node import PROCESSES
from softloop.wire.channels import EVENT
from softloop.wire.messages import constant, message
from softloop.wire.session import Wire

_EVENT = message("Event")
_SOURCE = constant("Event", "SOURCE_LAUNCHER")
_PROCESS, _FAULT = constant("Event", "KIND_PROCESS"), constant("Event", "KIND_FAULT")
_SOURCES = {process.name: constant("Event", process.source) for process in PROCESSES}


class LauncherEvents:
    """Publishes them, counted. Stamps are of the machine's clock, as all are at wall pace."""

    def __init__(self, wire: Wire) -> None:
        self._put = wire.publisher(EVENT)
        self._seq = 0

    def process(self, name: str, back: bool, seconds: float) -> None:
        """Process `name` was lost, or is back after so many `seconds`. A lost recorder cannot hear the former."""
        self._say(_PROCESS, int(back), _SOURCES.get(name, 0), seconds)

    def fault(self, reason: int, code: int) -> None:
        """An injection (FAULT_*) began (1) or ended (0)."""
        self._say(_FAULT, code, reason, 0.0)

    def _say(self, kind: int, code: int, reason: int, value: float) -> None:
        self._seq += 1
        event = _EVENT.make(
            seq=self._seq, stamp_ns=time.monotonic_ns(), source=_SOURCE, kind=kind, code=code, reason=reason, value=value
        )
        self._put(_EVENT.pack(event))
