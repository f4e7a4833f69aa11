"""Whether a shared meeting point is there, as a launcher sees it, and what its absence excuses.

Where all goes by way of a router (`[zenoh] mode = "client"`), its loss is silence on every wire: the gate goes to FAULT and
vents. That is no reason to end the run: when the router is back, all is, and the gate waits for a person to arm it again.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from softloop.wire.session import Wire

EXCUSE_S = 5.0  # what is found so soon after its return came of its absence


class Meeting:
    """`tell` takes (back, seconds away). Nothing is watched by a launcher that is the meeting point itself."""

    def __init__(self, wire: Wire, *, watched: bool, say: Callable[[str], None], tell: Callable[[bool, float], None]) -> None:
        self._wire, self._watched, self._say, self._tell = wire, watched, say, tell
        self._lost_s: float | None = None
        self._back_s = float("-inf")
        self.awaits_arming = False

    @property
    def away_s(self) -> float:
        """For how long it has been gone; 0 while it is there."""
        return 0.0 if self._lost_s is None else time.monotonic() - self._lost_s

    @property
    def excuses(self) -> bool:
        """What is silent or at fault now may be so because of it."""
        return self._lost_s is not None or time.monotonic() - self._back_s < EXCUSE_S

    def look(self, fault: str | None) -> None:
        """See whether it is there; `fault` is why the gate is in FAULT, None when it is not."""
        if self._watched:
            self._note(there=bool(self._wire.session.info.routers_zid()))
        if fault is None:
            self.awaits_arming = False
        elif self.excuses and self._lost_s is None and not self.awaits_arming:
            self.awaits_arming = True
            self._say(f"the gate is in FAULT ({fault}) and vented; it waits to be armed again: softloop request BENCH arm")

    def _note(self, *, there: bool) -> None:
        if there and self._lost_s is not None:
            away_s, self._lost_s, self._back_s = self.away_s, None, time.monotonic()
            self._say(f"the meeting point is back after {away_s:.1f} s")
            self._tell(True, away_s)
        elif not there and self._lost_s is None:
            self._lost_s = time.monotonic()
            self._say("the meeting point is lost; the run goes on when it is back")
            self._tell(False, 0.0)
