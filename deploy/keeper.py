"""Bringing back what a run does not depend on: the recorder and the viewers, when they die, with back-off.

No process of the control path is ever kept: what is left of a rig that lost one is not to be trusted, and vents.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from softloop.deploy.children import Child

FIRST_WAIT_S = 0.5
LONGEST_WAIT_S = 30.0
# One that lived for so long had come up: its next death is a new one. One that left by itself sooner, at its very first
# start, cannot run on this bench at all (a port in use, an extra that is not installed), and is left alone.
LIVED_S = 5.0


@dataclass
class BackOff:
    """How long to wait before the next start: twice as long each time, from the start again after a life of `LIVED_S`."""

    wait_s: float = 0.0

    def after(self, lived_s: float) -> float:
        """The wait after a life of `lived_s`."""
        again = self.wait_s > 0.0 and lived_s < LIVED_S
        self.wait_s = min(2.0 * self.wait_s, LONGEST_WAIT_S) if again else FIRST_WAIT_S
        return self.wait_s


@dataclass
class Kept:
    """One process that is brought back.

    Attributes:
        child: as it runs now, or ran last.
        start: starts it anew.
        is_back: whether a started one has come up, so far that it hears what is said of it.
        needed: it is brought back even when it could not start, or left in good order.
    """

    child: Child
    start: Callable[[], Child]
    is_back: Callable[[], bool] = lambda: True
    needed: bool = False
    starts: int = 1
    gone: bool = False
    began_s: float = 0.0
    died_s: float | None = None
    next_s: float | None = None
    back_off: BackOff = field(default_factory=BackOff)

    @property
    def name(self) -> str:
        return self.child.name


class Keeper:
    """Looks after all that is kept.

    `say` takes a line for a person; `tell` takes (name, back, seconds): a process was lost, or is back after so many seconds.
    """

    def __init__(self, say: Callable[[str], None], tell: Callable[[str, bool, float], None]) -> None:
        self._say, self._tell = say, tell
        self._all: list[Kept] = []

    def keep(self, kept: Kept, now_s: float) -> None:
        """Look after one more, which was started lately."""
        kept.began_s = now_s
        self._all.append(kept)

    @property
    def names(self) -> set[str]:
        return {kept.name for kept in self._all}

    def look(self, now_s: float) -> None:
        """See who died, start whose wait is over, and say who is back. Never waits."""
        for kept in self._all:
            if kept.gone:
                continue
            if kept.next_s is not None:
                if now_s >= kept.next_s:
                    self._start(kept, now_s)
            elif kept.child.exit_code() is not None:
                self._lost(kept, now_s)
            elif kept.died_s is not None and kept.is_back():
                self._say(f"process '{kept.name}' is back")
                self._tell(kept.name, True, now_s - kept.died_s)
                kept.died_s = None

    def _lost(self, kept: Kept, now_s: float) -> None:
        lived_s, code = now_s - kept.began_s, kept.child.exit_code() or 0
        if not kept.needed and (code == 0 or (code > 0 and kept.starts == 1 and lived_s < LIVED_S)):
            kept.gone = True
            self._say(f"{kept.child.epitaph()}; the run goes on without it")
            return
        wait_s = kept.back_off.after(lived_s)
        kept.next_s = now_s + wait_s
        self._say(f"{kept.child.epitaph()}; it is started again in {wait_s:g} s")
        if kept.died_s is None:  # one that dies again before it was back is the same loss
            kept.died_s = now_s
            self._tell(kept.name, False, 0.0)

    def _start(self, kept: Kept, now_s: float) -> None:
        kept.next_s = None
        kept.began_s = now_s
        kept.starts += 1
        kept.child = kept.start()
