"""Time: one injected clock per process, and absolute deadlines that never burst after a stall."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol


class Clock(Protocol):
    """What a process may ask of time. Nanoseconds of the rig clock."""

    def now_ns(self) -> int:
        """The rig clock."""
        ...

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at `deadline_ns` or later."""
        ...


class WallClock:
    """The machine's monotonic clock, shared by all processes of one machine."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def sleep_until_ns(self, deadline_ns: int) -> None:
        left = deadline_ns - time.monotonic_ns()
        if left > 0:
            time.sleep(left * 1e-9)


@dataclass
class Deadlines:
    """Absolute deadlines every `period_ns`, re-anchored after an overrun.

    After a tick that ended late by one period or more, the deadlines that have passed are skipped and counted; the next
    one is the first that lies ahead. There is never a burst of ticks to catch up.
    """

    period_ns: int
    next_ns: int
    tick: int = 0
    skipped: int = 0
    skipped_total: int = 0

    def advance(self, now_ns: int) -> None:
        """Choose the next deadline; `skipped` says how many were left out just now."""
        behind = now_ns - (self.next_ns + self.period_ns)
        self.skipped = -(-behind // self.period_ns) if behind > 0 else 0
        self.skipped_total += self.skipped
        self.tick += 1 + self.skipped
        self.next_ns += (1 + self.skipped) * self.period_ns
