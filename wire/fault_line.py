"""A line on which things get lost, late, doubled, swapped or spoiled: the pure part of injecting faults.

Nothing here knows of CAN, bytes or Zenoh. Chance comes from a generator of each injection's own, named by seed, place and
process, so that equal runs are spoiled equally.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from itertools import count
from random import Random
from typing import Generic, TypeVar

from softloop.wire.fault_config import ALWAYS_S, InjectionConfig

T = TypeVar("T")
_S = 1_000_000_000
_MS = 1_000_000


class Strike:
    """One injection as one process carries it out.

    Args:
        armed_ns: the rig clock at which the gate was armed, None before.
        say: called with (1 it came or 0 it left, the instant) when that is noticed.
    """

    def __init__(
        self, config: InjectionConfig, random: Random, armed_ns: Callable[[], int | None], say: Callable[[int, int], None]
    ) -> None:
        self.config, self.random = config, random
        self.action = config.action
        self.held: float | None = None  # what a stuck value is stuck at
        self._armed_ns, self._say = armed_ns, say
        self._was_on = False

    def on(self, now_ns: int) -> bool:
        """Whether it acts at `now_ns` (rig clock)."""
        armed_ns = self._armed_ns()
        if armed_ns is None:
            return False
        begin_ns = armed_ns + round(self.config.at_s * _S)
        end_ns = begin_ns + round(min(self.config.duration_s, ALWAYS_S) * _S)
        on = begin_ns <= now_ns < end_ns
        if on != self._was_on:
            self._was_on = on
            self._say(int(on), begin_ns if on else end_ns)
        if not on:
            self.held = None
        return on

    def hits(self, now_ns: int) -> bool:
        """Whether it acts on the thing that passes at `now_ns`; call once for each."""
        return self.on(now_ns) and (self.config.probability >= 1.0 or self.random.random() < self.config.probability)


class Line(Generic[T]):
    """What passes from one end to the other, with its injections.

    Args:
        strikes: in the order in which they act.
        alter: spoils one thing in the way of a strike that is none of drop, delay, duplicate and reorder.
    """

    def __init__(self, strikes: list[Strike], alter: Callable[[T, Strike], T]) -> None:
        self._strikes, self._alter = strikes, alter
        self._under_way: list[tuple[int, int, T]] = []
        self._behind: list[tuple[int, T]] = []  # what waits until the next one has passed it
        self._order = count()

    def put(self, thing: T, now_ns: int) -> None:
        """Something comes in at `now_ns`."""
        things, delay_ns, swapped = [thing], 0, False
        for strike in self._strikes:
            if not strike.hits(now_ns):
                continue
            if strike.action == "drop":
                things = []
            elif strike.action == "delay":
                delay_ns += round(strike.config.size * _MS)
            elif strike.action == "duplicate":
                things *= 2
            elif strike.action == "reorder":
                swapped = True
            else:
                things = [self._alter(each, strike) for each in things]
        arriving = [(now_ns + delay_ns, each) for each in things]
        if swapped and not self._behind:
            self._behind = arriving
            return
        self._send(arriving, now_ns)
        self._send(self._behind, now_ns)
        self._behind = []

    def _send(self, arriving: list[tuple[int, T]], now_ns: int) -> None:
        for due_ns, thing in arriving:
            heapq.heappush(self._under_way, (max(due_ns, now_ns), next(self._order), thing))

    def take(self, now_ns: int) -> T | None:
        """The next thing that has arrived by `now_ns`, or None."""
        if not self._under_way or self._under_way[0][0] > now_ns:
            return None
        return heapq.heappop(self._under_way)[2]

    def take_all(self, now_ns: int) -> list[T]:
        """All that has arrived by `now_ns`, in order."""
        taken = []
        while (thing := self.take(now_ns)) is not None:
            taken.append(thing)
        return taken


def flip_bits(data: bytes, strike: Strike, first: int = 0, end: int | None = None) -> bytes:
    """`data` with as many bits flipped as the strike's size says, at least one, in bytes `first` to before `end`."""
    spoiled, stop = bytearray(data), len(data) if end is None else end
    for _ in range(max(1, round(strike.config.size)) if stop > first else 0):
        bit = strike.random.randrange(8 * first, 8 * stop)
        spoiled[bit // 8] ^= 1 << (bit % 8)
    return bytes(spoiled)
