"""A running bench at a glance: rates, gaps, ages, lateness, loads, from the messages that went by."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softloop.wire.channels import (
    CAN,
    CAN_BUS,
    CYCLE,
    EVENT,
    PRESSURE,
    SHADOW,
    STATUS,
    VALVES,
    WATERMARK,
    Channel,
    channel_of_key,
)
from softloop.wire.messages import BadPayload, constant, message, names_of

RATE_WINDOW_S = 2.0
LATE_TICKS = 12_000  # a minute
RECENT_TICKS = 2_000  # ten seconds
LATE_EDGES_US = np.concatenate([[0.0], np.geomspace(10.0, 100_000.0, 25), [np.inf]])  # six bins a decade, 10 us to 100 ms
_PLANT, _KIND_FAULT = constant("Event", "SOURCE_PLANT"), constant("Event", "KIND_FAULT")
_STARTING = constant("ProcessStatus", "STATE_STARTING")
_NODES = {number: name.replace("_", " ") for number, name in names_of("CanBusStatus", "NODE_").items()}
_BUS_STATES = {number: name.replace("_", " ") for number, name in names_of("CanBusStatus", "STATE_").items()}
_KEPT = {CYCLE.name, VALVES.name, PRESSURE.name, SHADOW.name}
FrameTime = Callable[[int, int], int]  # data bytes, bit/s -> ns on the bus


@dataclass
class Lane:
    """What went by on one key."""

    channel: Channel
    count: int = 0
    missing: int = 0
    seq: int = 0
    heard_s: float = 0.0
    marks: deque[tuple[float, int]] = field(default_factory=deque)

    def note(self, seq: int, now_s: float) -> None:
        if 0 < self.seq < seq:
            self.missing += seq - self.seq - 1
        self.seq, self.heard_s = seq, now_s
        self.count += 1

    def mark(self, now_s: float) -> None:
        """Remember how far the count is; called at every look."""
        self.marks.append((now_s, self.count))
        while len(self.marks) > 2 and now_s - self.marks[1][0] >= RATE_WINDOW_S:
            self.marks.popleft()

    @property
    def rate_hz(self) -> float:
        """Messages per second over the last `RATE_WINDOW_S`."""
        if len(self.marks) < 2:
            return 0.0
        (first_s, first), (last_s, last) = self.marks[0], self.marks[-1]
        return (last - first) / (last_s - first_s) if last_s > first_s else 0.0


@dataclass
class Bus:
    """A CAN bus: how long its frames stood on it, and of an emulated one what it says of itself (`CanBusStatus`)."""

    bitrate: int
    status: Any = None
    busy_ns: int = 0
    marks: deque[tuple[float, int]] = field(default_factory=deque)

    @property
    def load_percent(self) -> float:
        """Share of time taken by frames, each at its longest stuffing, over the last `RATE_WINDOW_S`.

        Of an emulated bus, what that counts: exact lengths and error frames, over its last second.
        """
        if self.status is not None:
            return float(100.0 * self.status.load)
        if len(self.marks) < 2 or self.marks[-1][0] <= self.marks[0][0]:
            return 0.0
        return (self.marks[-1][1] - self.marks[0][1]) * 1e-7 / (self.marks[-1][0] - self.marks[0][0])

    @property
    def words(self) -> str:
        """What else an emulated bus says: its nodes that are not well, what was destroyed, how long frames waited."""
        if self.status is None:
            return ""
        told = self.status
        places = range(min(told.nodes, len(told.state)))
        counts = [f"{told.transmit_errors[k]}/{told.receive_errors[k]}" for k in places]
        ill = [
            f"{_NODES.get(k, f'node {k}')} {_BUS_STATES.get(told.state[k], told.state[k])} ({counts[k]})"
            for k in places
            if told.state[k]
        ]
        disturbed = [f"{told.disturbed} disturbed"] if told.disturbed else []
        refused = [f"{told.refused} refused"] if told.refused else []
        return ", ".join([*ill, *disturbed, *refused, f"waited {told.waited_max_ns * 1e-6:.2f} ms at most"])

    def mark(self, now_s: float) -> None:
        self.marks.append((now_s, self.busy_ns))
        while len(self.marks) > 2 and now_s - self.marks[1][0] >= RATE_WINDOW_S:
            self.marks.popleft()


class Overview:
    """Takes messages of a bench and keeps what a person wants to know.

    Attributes:
        lanes: key -> what went by there.
        buses: CAN bus -> its load.
        newest: channel name -> its newest message; `cycle`, `valves` and `pressure` are short for these, or None.
        statuses: process -> (newest `ProcessStatus`, when it came).
        events: the newest events, oldest first.
        broken: Event FAULT_* -> how many such faults stand in the rig, by its events since it began.
        cycles: the cycle records of the last `take`.
    """

    def __init__(
        self,
        bench: str,
        bitrates: Mapping[str, int],
        processes: Mapping[int, str],
        frame_ns: FrameTime,
        events_kept: int = 200,
        emulated: Sequence[str] = (),
    ) -> None:
        """`emulated`: the buses' names in the order of `CanBusStatus.bus`."""
        self._emulated = emulated
        self._bench = bench
        self._processes = processes
        self._frame_ns = frame_ns
        self._late_ns: deque[int] = deque(maxlen=LATE_TICKS)
        self.lanes: dict[str, Lane] = {}
        self.buses = {name: Bus(bitrate) for name, bitrate in bitrates.items()}
        self.newest: dict[str, Any] = {}
        self.statuses: dict[str, tuple[Any, float]] = {}
        self.events: deque[Any] = deque(maxlen=events_kept)
        self.events_seen = 0
        self.broken: Counter[int] = Counter()
        self.cycles: list[Any] = []
        self.malformed = 0

    @property
    def cycle(self) -> Any:
        return self.newest.get(CYCLE.name)

    @property
    def valves(self) -> Any:
        return self.newest.get(VALVES.name)

    @property
    def pressure(self) -> Any:
        return self.newest.get(PRESSURE.name)

    def take(self, messages: Iterable[tuple[str, bytes]], now_s: float | None = None) -> None:
        """Take what arrived, (key, payload) each; `now_s` is this machine's monotonic clock."""
        now_s = time.monotonic() if now_s is None else now_s
        self.cycles = []
        for full_key, payload in messages:
            known = self.lanes.get(full_key) or self._new_lane(full_key)
            if known is None:
                continue
            try:
                self._note(known, full_key, payload, now_s)
            except BadPayload:
                self.malformed += 1
        for lane in self.lanes.values():
            lane.mark(now_s)
        for bus in self.buses.values():
            bus.mark(now_s)

    def _new_lane(self, full_key: str) -> Lane | None:
        channel = channel_of_key(self._bench, full_key)
        if channel is None or channel is WATERMARK or len(self.lanes) > 10_000:  # strangers' keys must not eat the memory
            return None
        return self.lanes.setdefault(full_key, Lane(channel))

    def _note(self, lane: Lane, full_key: str, payload: bytes, now_s: float) -> None:
        unpacked = message(lane.channel.message).unpack(payload)
        # Several senders count for themselves on these two, so a gap there says nothing.
        lane.note(0 if lane.channel in (EVENT, STATUS, CAN) else unpacked.seq, now_s)
        if lane.channel.name in _KEPT:
            self.newest[lane.channel.name] = unpacked
        if lane.channel is CYCLE:
            self._late_ns.append(unpacked.woken_ns - unpacked.stamp_ns)
            self.cycles.append(unpacked)
        elif lane.channel is CAN:
            self._note_frame(full_key.split("/")[3], unpacked)
        elif lane.channel is CAN_BUS and unpacked.bus < len(self._emulated):
            self.buses[self._emulated[unpacked.bus]].status = unpacked
        elif lane.channel is STATUS:
            name = self._processes.get(unpacked.process, f"process {unpacked.process}")
            self.statuses[name] = (unpacked, now_s)
            if unpacked.process == _PLANT and unpacked.state == _STARTING:
                self.broken.clear()
        elif lane.channel is EVENT:
            self._note_event(unpacked)

    def _note_event(self, event: Any) -> None:
        self.events.append(event)
        self.events_seen += 1
        if event.kind == _KIND_FAULT:
            self.broken[event.reason] = max(0, self.broken[event.reason] + (1 if event.code else -1))

    def _note_frame(self, name: str, frame: Any) -> None:
        bus = self.buses.get(name)
        if bus is not None:
            bus.busy_ns += self._frame_ns(min(frame.dlc, 8), bus.bitrate)

    def lateness_us(self) -> NDArray[np.float64]:
        """Woken less scheduled of the last minute's ticks, oldest first, us, (n,)."""
        return np.array(self._late_ns, float) * 1e-3

    def lateness_histogram(self) -> list[int]:
        """Ticks of the last minute in the bins of `LATE_EDGES_US`; early ones count as on time."""
        return [int(n) for n in np.histogram(np.maximum(self.lateness_us(), 0.0), LATE_EDGES_US)[0]]

    def lateness_spread_us(self) -> dict[str, float]:
        """Median, 99th percentile and maximum of the last ten seconds, us; empty without ticks."""
        late = self.lateness_us()[-RECENT_TICKS:]
        if not late.size:
            return {}
        return {"p50": float(np.median(late)), "p99": float(np.percentile(late, 99.0)), "max": float(late.max())}
