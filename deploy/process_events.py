"""The launcher's own events: a process that it lost, and one that is back."""

from __future__ import annotations

import time

from softloop.deploy.node import PROCESSES
from softloop.wire.channels import EVENT
from softloop.wire.messages import constant, message
from softloop.wire.session import Wire

_SOURCE = constant("Event", "SOURCE_LAUNCHER")
_KIND = constant("Event", "KIND_PROCESS")
_SOURCES = {process.name: constant("Event", process.source) for process in PROCESSES}


class ProcessEvents:
    """Publishes them, counted. Stamps are of the machine's clock, as all are at wall pace."""

    def __init__(self, wire: Wire) -> None:
        self._put = wire.publisher(EVENT)
        self._seq = 0

    def tell(self, name: str, back: bool, seconds: float) -> None:
        """Process `name` was lost, or is back after so many `seconds`. A lost recorder cannot hear the former."""
        self._seq += 1
        event = message("Event").make(
            seq=self._seq,
            stamp_ns=time.monotonic_ns(),
            value=seconds,
            source=_SOURCE,
            kind=_KIND,
            code=int(back),
            reason=_SOURCES.get(name, 0),
        )
        self._put(message("Event").pack(event))
