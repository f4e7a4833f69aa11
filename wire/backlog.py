"""Everything that arrives on a key expression, kept for one who takes it in batches: the recorder's way in."""

from __future__ import annotations

from typing import Any

import zenoh


class Backlog:
    """All samples of a key expression, oldest first; bounded: when nobody takes, the oldest go.

    The samples wait in Zenoh's own ring, so that its receiving thread never needs the interpreter. With a callback it does, once
    per message, and gets it from a busy loop once in half a millisecond only; then the senders' buffers fill, and they drop.

    The ring does not tell how many it let go. `take_all` says when it was full; how many are missing then, the senders' numbers
    say.
    """

    def __init__(self, session: zenoh.Session, key_expr: str, capacity: int) -> None:
        self._capacity = capacity
        self._session, self._key_expr = session, key_expr
        self._kept: list[tuple[str, bytes]] = []  # taken when the subscription was renewed
        self._subscriber = self._subscribe()

    def _subscribe(self) -> Any:
        return self._session.declare_subscriber(self._key_expr, zenoh.handlers.RingChannel(self._capacity))

    def renew(self) -> None:
        """Subscribe anew, so that every neighbour hears of it again; what is sent in that moment is lost."""
        self._kept = self.take_all()[0]  # the ring goes with its subscription
        self._subscriber.undeclare()
        self._subscriber = self._subscribe()

    def take_all(self) -> tuple[list[tuple[str, bytes]], bool]:
        """(key, payload) of all that waits, oldest first, without waiting; and whether as much came as can wait."""
        take = self._subscriber.try_recv
        taken, self._kept = self._kept, []
        for _ in range(self._capacity):
            sample = take()
            if sample is None:
                return taken, False
            taken.append((str(sample.key_expr), sample.payload.to_bytes()))
        return taken, True
