"""What a run may be without for a while, as a launcher sees it, and what its absence excuses.

Where all goes by way of a router (`[zenoh] mode = "client"`), its loss is silence on every wire; where a cable between hosts is
cut, all that is behind it is silent. The gate goes to FAULT and vents. That is no reason to end the run: when what was away is
back, the gate waits for a person to arm it again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from dataclasses import dataclass

from softloop.wire.session import Wire

EXCUSE_S = 5.0  # what is found so soon after its return came of its absence


@dataclass
class Absence:
    """Since when something has been away, and when it last came back."""

    lost_s: float | None = None
    back_s: float = float("-inf")

    @property
    def away_s(self) -> float:
        """For how long it has been away; 0 while it is there."""
        return 0.0 if self.lost_s is None else time.monotonic() - self.lost_s

    @property
    def excuses(self) -> bool:
        """What is silent or at fault now may be so because of it."""
        return self.lost_s is not None or time.monotonic() - self.back_s < EXCUSE_S

    def note(self, *, there: bool) -> tuple[bool, float] | None:
        """Whether it came back, and after how many seconds; None where nothing changed."""
        if there == (self.lost_s is None):
            return None
        away_s = self.away_s
        self.lost_s = None if there else time.monotonic()
        self.back_s = time.monotonic() if there else self.back_s
        return there, away_s


class Meeting:
    """The shared meeting point and the bench's other hosts.

    `tell` takes (back, seconds away) of the meeting point, `tell_host` the host's number before these. The meeting point is not
    watched by a launcher that is it.
    """

    def __init__(
        self,
        wire: Wire,
        *,
        watched: bool,
        say: Callable[[str], None],
        tell: Callable[[bool, float], None],
        tell_host: Callable[[int, bool, float], None] = lambda *_: None,
    ) -> None:
        self._wire, self._watched, self._say, self._tell, self._tell_host = wire, watched, say, tell, tell_host
        self._router = Absence()
        self._hosts: dict[tuple[int, str], Absence] = {}
        self._fault_since_s: float | None = None
        self.awaits_arming = False

    @property
    def away_s(self) -> float:
        """For how long the meeting point has been gone; 0 while it is there."""
        return self._router.away_s

    @property
    def excuses_hosts(self) -> bool:
        """The silence of whole hosts may be that of the meeting point."""
        return self._router.excuses

    @property
    def excuses(self) -> bool:
        """What is silent or at fault now may be so because of what is away, or was lately."""
        return self._router.excuses or any(host.excuses for host in self._hosts.values())

    def fault_counts(self, judged_s: float) -> bool:
        """The FAULT that was looked at is excused by nothing. What excuses it may be found `judged_s` later."""
        lately = self._fault_since_s is not None and time.monotonic() - self._fault_since_s < judged_s
        return not (self.excuses or self.awaits_arming or lately)

    def look(self, fault: str | None, quiet: Collection[tuple[int, str]] = ()) -> None:
        """See what is there; `fault` is why the gate is in FAULT, None when it is not, `quiet` (number, name) of silent hosts."""
        if self._watched:
            self._note_router(self._router.note(there=bool(self._wire.session.info.routers_zid())))
        for host in {*quiet, *self._hosts}:
            self._note_host(*host, self._hosts.setdefault(host, Absence()).note(there=host not in quiet))
        if fault is None:
            self.awaits_arming, self._fault_since_s = False, None
            return
        self._fault_since_s = time.monotonic() if self._fault_since_s is None else self._fault_since_s
        everything_there = not any(one.lost_s is not None for one in (self._router, *self._hosts.values()))
        if self.excuses and everything_there and not self.awaits_arming:
            self.awaits_arming = True
            self._say(f"the gate is in FAULT ({fault}) and vented; it waits to be armed again: softloop request BENCH arm")

    def _note_router(self, change: tuple[bool, float] | None) -> None:
        if change is not None:
            back, away_s = change
            after = f"the meeting point is back after {away_s:.1f} s"
            self._say(after if back else "the meeting point is lost; the run goes on when it is back")
            self._tell(back, away_s)

    def _note_host(self, number: int, name: str, change: tuple[bool, float] | None) -> None:
        if change is not None:
            back, away_s = change
            after = f"host '{name}' is heard again after {away_s:.1f} s"
            self._say(after if back else f"host '{name}' is not heard; the run goes on if it is back soon")
            self._tell_host(number, back, away_s)
