"""A cable that delays and loses packets, as a seeded queue. Pure: no clock is read and nothing is sent here.

What happens to packet number n of a direction follows from the seed, the direction and n alone: equal seeds lose the same
packets, whenever they come. Order is kept, as a wire and a switch keep it: one packet that is late holds those behind it.
"""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass

LIMIT = 1000  # packets on their way in one direction; what comes then is dropped, as netem does


@dataclass(frozen=True)
class Way:
    """What a direction does to packets.

    Attributes:
        delay_ms: of every packet.
        jitter_ms: on top of it, evenly from none to this.
        loss: part of the packets that is lost, each by itself.
    """

    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    loss: float = 0.0

    def __post_init__(self) -> None:
        """Raises ValueError for what no cable does."""
        if not (0.0 <= self.delay_ms <= 10_000.0 and 0.0 <= self.jitter_ms <= 10_000.0):
            raise ValueError("delay and jitter must be between 0 and 10000 ms")
        if not 0.0 <= self.loss <= 1.0:
            raise ValueError("loss must be between 0 and 1")


class Cable:
    """One direction between two hosts. Times are ns of whatever clock the caller reads.

    Attributes:
        put_in, lost, overrun, passed: packets so far; `put_in` is the sum of the others and of those under way.
    """

    def __init__(self, way: Way, seed: int, direction: str = "") -> None:
        self.way = way
        self.put_in = self.lost = self.overrun = self.passed = 0
        self._chance = random.Random(f"{seed} {direction}")
        self._under_way: deque[tuple[int, bytes]] = deque()
        self._last_due_ns = -(2**63)

    def put(self, packet: bytes, now_ns: int) -> None:
        """Take a packet that came in at `now_ns`."""
        self.put_in += 1
        is_lost, jitter = self._chance.random() < self.way.loss, self._chance.random()  # always both: n decides, nothing else
        if is_lost:
            self.lost += 1
            return
        if len(self._under_way) >= LIMIT:
            self.overrun += 1
            return
        due_ns = now_ns + round((self.way.delay_ms + self.way.jitter_ms * jitter) * 1e6)
        self._last_due_ns = max(due_ns, self._last_due_ns)
        self._under_way.append((self._last_due_ns, packet))

    @property
    def next_ns(self) -> int | None:
        """When the next packet is to come out, None when none is under way."""
        return self._under_way[0][0] if self._under_way else None

    def take(self, now_ns: int) -> list[tuple[int, bytes]]:
        """(due, packet) of all that is to be out by `now_ns`, in order."""
        out: list[tuple[int, bytes]] = []
        while self._under_way and self._under_way[0][0] <= now_ns:
            out.append(self._under_way.popleft())
        self.passed += len(out)
        return out
