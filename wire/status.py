"""What every process says of itself: its status once a second, and events when they happen."""

from __future__ import annotations

import os

from softloop.wire.channels import EVENT, STATUS
from softloop.wire.messages import constant, message
from softloop.wire.shell import Context

_STATUS = message("ProcessStatus")
_EVENT = message("Event")
_STARTING, _RUNNING, _STOPPING = (constant("ProcessStatus", f"STATE_{s}") for s in ("STARTING", "RUNNING", "STOPPING"))


class StatusReporter:
    """Publishes `ProcessStatus`: once when the loop is entered, then once a second from `cycle`, and at `close`.

    Attributes:
        dropped: what this process had to drop, in total; the process counts it up itself.
    """

    def __init__(self, context: Context, source: int) -> None:
        """`source`: Event SOURCE_* of this process."""
        self.dropped = 0
        self._clock = context.clock
        self._put = context.wire.publisher(STATUS)
        self._who = {"pid": 0 if context.pace.exact else os.getpid(), "process": source, "realtime": int(context.realtime)}
        self._period_ns = round(1e9 / STATUS.rate_hz)
        self._seq = self._cycles = self._skipped = self._late_max_ns = 0
        self._due_ns = self._clock.now_ns() + self._period_ns
        context.on_begin.append(lambda: self._publish(_STARTING))

    def cycle(self, late_ns: int = 0, skipped: int = 0) -> None:
        """One turn of the process's loop, `late_ns` behind its time, after `skipped` that were left out."""
        self._cycles += 1
        self._skipped += skipped
        self._late_max_ns = max(self._late_max_ns, late_ns)
        now_ns = self._clock.now_ns()
        if now_ns >= self._due_ns:
            self._due_ns = max(self._due_ns + self._period_ns, now_ns)
            self._publish(_RUNNING)

    def close(self) -> None:
        """The last word."""
        self._publish(_STOPPING)

    def _publish(self, state: int) -> None:
        self._seq += 1
        status = _STATUS.make(
            seq=self._seq,
            stamp_ns=self._clock.now_ns(),
            cycles=self._cycles,
            skipped=self._skipped,
            dropped=self.dropped,
            late_max_ns=self._late_max_ns,
            state=state,
            **self._who,
        )
        self._late_max_ns = 0
        self._put(_STATUS.pack(status))


class EventReporter:
    """Publishes `Event`s of one process, counted."""

    def __init__(self, context: Context, source: int) -> None:
        """`source`: Event SOURCE_* of this process."""
        self._put = context.wire.publisher(EVENT)
        self._source = source
        self._numbers = context.event_numbers

    def say(self, kind: int, stamp_ns: int, *, code: int = 0, reason: int = 0, value: float = 0.0, tick: int = 0) -> None:
        """One event; `kind` is Event KIND_*, `stamp_ns` the rig clock."""
        number = next(self._numbers)
        event = _EVENT.make(
            seq=number, stamp_ns=stamp_ns, tick=tick, value=value, source=self._source, kind=kind, code=code, reason=reason
        )
        self._put(_EVENT.pack(event))
