"""From the wire to the viewers: one pump takes what came, thirty times a second, and every viewer reads from what it left."""

from __future__ import annotations

import asyncio
import time
from typing import Any

from softloop.watch.overview import Overview
from softloop.watch.page.history import History
from softloop.watch.page.state import EventLine, as_json, events_of, state_of
from softloop.wire.backlog import Backlog
from softloop.wire.channels import CAN, CYCLE, EVENT, PRESSURE, ROOT, STATUS, VALVES, key
from softloop.wire.session import Wire

FRAME_S = 1.0 / 30.0
STATE_EVERY = 3  # frames
CAPACITY = 4096  # of each channel: 20 s of a fast one
TICKS_PER_S = 200
SILENT_S = 2.0
CHANNELS = (CYCLE, VALVES, PRESSURE, EVENT, STATUS)


class Feed:
    """What viewers read: `history`, `state`, `events`; `wait` returns when there is more.

    Attributes:
        frame: counts the frames of the pump.
        state, events: JSON, made once for all viewers.
        events_seen: goes up with `events`.
    """

    def __init__(self, overview: Overview, event_line: EventLine, history_s: float) -> None:
        self.overview = overview
        self.history = History(int(history_s * TICKS_PER_S))
        self.frame = 0
        self.state = as_json(state_of(overview))
        self.events = as_json(events_of(overview, event_line, 0))
        self.events_seen = 0
        self.more: dict[str, Any] = {}  # what else the state is to hold
        self._event_line = event_line
        self._inboxes: list[Backlog] = []
        self._renewed_s = 0.0
        self._waiting = asyncio.Event()

    def connect(self, wire: Wire) -> None:
        """Listen to a bench. From any thread, once."""
        keys = [key(wire.bench, channel) for channel in CHANNELS] + [f"{ROOT}/{wire.bench}/{CAN.name}/**"]
        self._inboxes = [Backlog(wire.session, one, CAPACITY) for one in keys]

    def gate(self) -> tuple[int | None, float]:
        """The gate's state, and when it was heard, s."""
        heard = [lane.heard_s for lane in self.overview.lanes.values() if lane.channel is VALVES]
        return (None if self.overview.valves is None else self.overview.valves.gate), max(heard, default=0.0)

    def gate_stamp_ns(self) -> int:
        """Of the gate's newest word, rig clock; 0 for none yet."""
        return 0 if self.overview.valves is None else int(self.overview.valves.stamp_ns)

    async def pump(self) -> None:
        """Turn frames until cancelled; a frame that came late is not caught up."""
        next_s = time.monotonic()
        while True:
            self.turn(time.monotonic())
            waiting, self._waiting = self._waiting, asyncio.Event()
            waiting.set()
            next_s = max(next_s + FRAME_S, time.monotonic())
            await asyncio.sleep(next_s - time.monotonic())

    def turn(self, now_s: float) -> None:
        """One frame: take what came, and now and then say anew how things are."""
        self.frame += 1
        self.overview.take([item for inbox in self._inboxes for item in inbox.take_all()[0]], now_s)
        self.history.append(self.overview.cycles)
        if self.frame % STATE_EVERY == 0:
            self.state = as_json(state_of(self.overview, now_s) | {"start_ns": self.history.start_ns} | self.more)
            self._listen_again(now_s)
        if self.overview.events_seen != self.events_seen:
            self.events_seen = self.overview.events_seen
            self.events = as_json(events_of(self.overview, self._event_line, self.history.start_ns))

    def _listen_again(self, now_s: float) -> None:
        """Where the gate has fallen silent, subscribe anew now and then: a bench that came back may not have heard of us."""
        _, heard_s = self.gate()
        if now_s - max(heard_s, self._renewed_s) > SILENT_S:
            self._renewed_s = now_s
            for inbox in self._inboxes:
                inbox.renew()

    async def wait(self) -> None:
        """Until the next frame."""
        await self._waiting.wait()
