"""Questions on a channel of a bench: one process answers each while it runs, and who asks waits for the answer."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import zenoh

from softloop.wire.channels import Channel, key
from softloop.wire.errors import BadConfig, Unavailable
from softloop.wire.session import Wire

WAITING_MAX = 16
# Who has just begun to answer is known to others only after a while: on a busy machine one of 60 questions that followed at once
# found nobody.
BECOMING_KNOWN_S = 1.0
_AGAIN_S = 0.05


class Question:
    """One question, to be answered once."""

    def __init__(self, query: Any) -> None:
        self._query = query
        self.payload: bytes = b"" if query.payload is None else query.payload.to_bytes()

    def accept(self) -> None:
        """It is done."""
        with self._query:
            self._query.reply(self._query.key_expr, b"")

    def refuse(self, why: str) -> None:
        """It is not done, with one line that says why."""
        with self._query:
            self._query.reply_err(why.encode())


class Questions:
    """What this process was asked on a channel, for its loop to take; more than `WAITING_MAX` at once are refused."""

    def __init__(self, wire: Wire, channel: Channel) -> None:
        self._waiting: deque[Question] = deque()
        handler = zenoh.handlers.Callback(self._receive, indirect=False)
        self._queryable = wire.session.declare_queryable(key(wire.bench, channel), handler)

    def _receive(self, query: zenoh.Query) -> None:
        question = Question(query)
        if len(self._waiting) >= WAITING_MAX:
            question.refuse(f"{WAITING_MAX} requests are waiting already")
        else:
            self._waiting.append(question)

    def take_all(self) -> list[Question]:
        """All that wait, oldest first, without waiting."""
        return [self._waiting.popleft() for _ in range(len(self._waiting))]


def ask(wire: Wire, channel: Channel, payload: bytes, timeout_s: float) -> None:
    """Ask, and return when it is done.

    Raises:
        BadConfig: refused, with the answer's words.
        Unavailable: nobody answers on this channel, or there is no right to ask.
    """
    if wire.identity is not None and not wire.identity.rights.may_ask(channel.name):
        raise wire.refused("ask on", channel)
    refusals = _ask_who_is_known(wire, channel, payload, timeout_s)
    if refusals is None:
        return
    words = [" ".join(words.split()) for words in refusals if words and words != "Timeout"]
    if words:
        raise BadConfig(words[0])
    raise Unavailable(f"nothing of bench '{wire.bench}' answers on '{channel.name}'")


def _ask_who_is_known(wire: Wire, channel: Channel, payload: bytes, timeout_s: float) -> list[str] | None:
    """As `_ask_once`, again for a while as long as the network knows of nobody to ask."""
    end = time.monotonic() + min(BECOMING_KNOWN_S, timeout_s)
    while (refusals := _ask_once(wire, channel, payload, timeout_s)) == [] and time.monotonic() < end:
        time.sleep(_AGAIN_S)
    return refusals


def _ask_once(wire: Wire, channel: Channel, payload: bytes, timeout_s: float) -> list[str] | None:
    """The refusals, none where the network knows of nobody to ask; None when it is done."""
    replies = wire.session.get(
        key(wire.bench, channel), payload=payload, timeout=timeout_s, congestion_control=zenoh.CongestionControl.BLOCK
    )
    refusals = []
    for reply in replies:
        if reply.ok is not None:
            return None
        refusals.append(reply.err.payload.to_bytes().decode(errors="replace") if reply.err else "")
    return refusals
