"""Lockstep pace: rig time goes on tick by tick, when everybody is done with the last one. Equal runs give equal bytes.

The plant leads. With each tick it says, per wire, how many frames or bytes it has sent in all and when each piece arrives
(`Tick`); an adapter takes exactly those, each at its arrival, and then says that it is done and which sample was its last
(`Watermark`), also when it published nothing. The controller waits for both adapters and the gate's last word, the gate for
the controller; the plant takes the gate's frame and goes on. No wait is without an end: one that lasts longer than `[pace]
timeout_s` names the process that is missing. Whoever waits for another that waits itself has more patience than that one, so
that it is the missing one that is named.

Nothing is sent before everybody is there: each process says hello, again and again, once all its subscriptions are declared,
and who has heard it knows of them, because on a link declarations go before what follows. At the end each waits for the
recorder, because what is under way when a session closes is lost.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Collection
from typing import Any

import zenoh

from softloop.wire.channels import END, HELLO, TICK, WATERMARK, Channel, pace_key
from softloop.wire.config import PaceConfig
from softloop.wire.errors import Lost
from softloop.wire.lockstep_inputs import (
    PacedBytes,
    PacedCommands,
    PacedFrames,
    PacedNewest,
    PacedRequests,
    PacedValveFrames,
    seq_of,
)
from softloop.wire.messages import BadPayload, constant, message
from softloop.wire.pace import ByteSource, FrameSource, Newest, Pace, Queue, Requests
from softloop.wire.schedule import PERIOD_NS, START_NS
from softloop.wire.session import Inbox, Wire
from softloop.wire.shell import Stop

PLANT, CONTROLLER, VALVES, RECORDER, LAUNCHER = "plant", "controller", "valves", "recorder", "launcher"
LISTENERS = (RECORDER, "shadow")  # the plant does not run far ahead of them
# Times `timeout_s` that is waited for whom: the farther along the chain of a tick, the longer.
PATIENCE = {CONTROLLER: 1.25, VALVES: 1.5, RECORDER: 1.5, PLANT: 2.0}
_TICK, _WATERMARK = message("Tick"), message("Watermark")
_WIRES, _PIECES = constant("Tick", "WIRES"), constant("Tick", "PIECES")
_HELLO_S = 0.02
_LOOK_S = 0.05  # how often a waiting process looks whether it has been asked to stop
# How far the plant may be ahead of a listener: 14 messages a tick, far fewer than its backlog holds.
LISTENER_TICKS = 200


class RigClock:
    """A clock that stands until it is set."""

    def __init__(self) -> None:
        self.value_ns = START_NS
        self.on_sleep: Callable[[int], None] = self.set

    def now_ns(self) -> int:
        return self.value_ns

    def set(self, value_ns: int) -> None:
        """Go to a time; never backward."""
        self.value_ns = max(self.value_ns, value_ns)

    def sleep_until_ns(self, deadline_ns: int) -> None:
        self.on_sleep(deadline_ns)


class Board:
    """What the others have said last: the plant's tick, who is there, and the watermarks of those who are followed."""

    def __init__(self, wire: Wire, interrupted: Callable[[], bool], timeout_s: float) -> None:
        self._changed = threading.Condition()
        self._interrupted, self._timeout_s = interrupted, timeout_s
        self._wire = wire
        self._declared: list[Any] = []
        self.tick: Any = None
        self.present: dict[str, Any] = {}
        self.marks: dict[str, Any] = {}
        self.ended: dict[str, Any] = {}
        self._listen(TICK, PLANT, self._take_tick)
        self._listen(HELLO, "*", self._note_in(self.present))

    def follow(self, process: str) -> None:
        """Hear the watermarks of a process."""
        self._listen(WATERMARK, process, self._note_in(self.marks))

    def await_end(self, process: str) -> None:
        """Hear that a process, or "*", is done for good."""
        self._listen(END, process, self._note_in(self.ended))

    def _listen(self, channel: Channel, process: str, take: Callable[[zenoh.Sample], None]) -> None:
        handler = zenoh.handlers.Callback(take, indirect=False)
        self._declared.append(self._wire.session.declare_subscriber(pace_key(self._wire.bench, channel, process), handler))

    def _take_tick(self, sample: zenoh.Sample) -> None:
        try:
            tick = _TICK.unpack(sample.payload.to_bytes())
        except BadPayload:
            return
        with self._changed:
            if self.tick is None or tick.seq > self.tick.seq:
                self.tick = tick
                self._changed.notify_all()

    def _note_in(self, board: dict[str, Any]) -> Callable[[zenoh.Sample], None]:
        def take(sample: zenoh.Sample) -> None:
            try:
                mark = _WATERMARK.unpack(sample.payload.to_bytes())
            except BadPayload:
                return
            with self._changed:
                board[str(sample.key_expr).rsplit("/", 1)[1]] = mark
                self._changed.notify_all()

        return take

    def done(self, process: str) -> int:
        """How many ticks a followed process is done with."""
        return int(self.marks[process].tick) if process in self.marks else 0

    def wait(
        self,
        ready: Callable[[], bool],
        missing: Callable[[], str],
        meanwhile: Callable[[], None] | None = None,
        patience: float = 1.0,
    ) -> bool:
        """Until `ready()`; False when asked to stop. `meanwhile` is called now and then.

        Raises Lost, naming `missing()`, after `patience` times the timeout.
        """
        limit_s = patience * self._timeout_s
        end_s = time.monotonic() + limit_s
        look_s = _LOOK_S if meanwhile is None else _HELLO_S
        with self._changed:
            while not ready():
                if self._interrupted():
                    return False
                if time.monotonic() >= end_s:
                    raise Lost(f"lockstep: nothing from {missing()} for {limit_s:g} s; the run cannot go on")
                if not self._changed.wait(look_s) and meanwhile is not None:
                    meanwhile()
        return True

    def wait_done(self, process: str, ticks: int) -> bool:
        """Until a followed process is done with so many ticks; False when asked to stop. Raises Lost."""
        return self.wait(
            lambda: self.done(process) >= ticks,
            lambda: f"'{process}' on tick {ticks - 1}",
            patience=PATIENCE.get(process, 1.0),
        )


class Lockstep(Pace):
    """What leader, followers and launcher share: the board, the clock and the own word."""

    exact = True
    period_ns = PERIOD_NS

    def __init__(self, config: PaceConfig, wire: Wire, stop: Stop, others: Collection[str]) -> None:
        """`others`: the processes of this bench, without this one."""
        self.rig_clock = RigClock()
        self.clock = self.rig_clock
        self.stop, self.others = stop, sorted(others)
        self.latency_ns, self.timeout_s = config.software_latency_us * 1000, config.timeout_s
        self.over = False
        self.requests_in: Callable[[], int] = lambda: 0
        wire.exact, wire.on_put = True, self._note_put
        self._put = {c.name: self._publisher(wire, c) for c in (HELLO, WATERMARK, END)}
        self.board = Board(wire, self.interrupted, config.timeout_s)
        self.board.await_end("*" if wire.process == RECORDER else RECORDER)
        self._said = self._last_seq = self._sent = self._sent_stamp_ns = 0

    @staticmethod
    def _publisher(wire: Wire, channel: Channel) -> Callable[[bytes], None]:
        publisher = wire.declare_publisher(pace_key(wire.bench, channel, wire.process), realtime=channel.realtime)
        put: Callable[[bytes], None] = publisher.put
        return put

    def interrupted(self) -> bool:
        """Asked to stop before the run's own end."""
        return bool(self.stop) and not self.over

    def say(self, channel: Channel, tick: int = 0, ticks: int = 0) -> None:
        """Publish the own word: done with `tick` ticks."""
        self._said += 1
        mark = _WATERMARK.make(
            seq=self._said,
            stamp_ns=self.clock.now_ns(),
            tick=tick,
            last_seq=self._last_seq,
            sent=self._sent,
            sent_stamp_ns=self._sent_stamp_ns,
            requests=self.requests_in(),
            ticks=ticks,
        )
        self._put[channel.name](_WATERMARK.pack(mark))

    def meet(self, wanted: Collection[str], meanwhile: Callable[[], None] | None) -> bool:
        """Until each of `wanted` has said hello; False when asked to stop. Raises Lost, naming who is missing."""
        present = self.board.present
        return self.board.wait(
            lambda: present.keys() >= set(wanted),
            lambda: ", ".join(repr(name) for name in wanted if name not in present),
            meanwhile,
        )

    def finish(self) -> None:
        """After the last word of this process."""
        if self.over and RECORDER in self.others:
            self.say(END)
            self.board.wait(lambda: RECORDER in self.board.ended, lambda: f"'{RECORDER}'")

    def end(self) -> None:
        """The run is over as planned."""
        self.over = True
        self.stop.set("the run is over")

    def _note_put(self, payload: bytes) -> None:
        self._last_seq = seq_of(payload)

    def note_sent(self, stamp_ns: int) -> None:
        self._sent += 1
        self._sent_stamp_ns = stamp_ns

    def lateness_ns(self, due_ns: int) -> int:
        return 0


class Leader(Lockstep):
    """The plant: its clock's sleep ends the tick, lets the others take theirs, and goes on to the next."""

    def __init__(self, config: PaceConfig, wire: Wire, stop: Stop, others: Collection[str]) -> None:
        super().__init__(config, wire, stop, others)
        self.rig_clock.on_sleep = self._end_tick
        self._put_tick = self._publisher(wire, TICK)
        for process in (VALVES, *LISTENERS):
            self.board.follow(process)
        self.target_ns = START_NS  # the rig clock of the tick in hand, once the frames of the last one are taken
        self._tick = self._ticks = 0
        self._pieces: list[list[tuple[int, int]]] = [[] for _ in range(_WIRES)]
        self._on_wire = [0] * _WIRES

    def begin(self) -> None:
        if self.meet([*self.others, LAUNCHER], lambda: self.say(HELLO)):
            self._ticks = int(self.board.present[LAUNCHER].ticks)

    def note_piece(self, wire: int, amount: int, arrival_ns: int) -> None:
        self._on_wire[wire] += amount
        self._pieces[wire].append((self._on_wire[wire], arrival_ns))

    def valve_frames(self, source: FrameSource, frame_ns: int) -> FrameSource:
        return PacedValveFrames(self, source, frame_ns)

    def _end_tick(self, deadline_ns: int) -> None:
        last = self._tick + 1 >= self._ticks
        self._announce(last)
        done = self._tick + 1
        self.board.wait_done(VALVES, done)
        for process in (p for p in LISTENERS if p in self.others):
            self.board.wait_done(process, done - LISTENER_TICKS)
        if last:
            self.end()
        self._tick += 1
        self.target_ns += PERIOD_NS

    def _announce(self, last: bool) -> None:
        piece_end, arrival_ns = [0] * (_WIRES * _PIECES), [0] * (_WIRES * _PIECES)
        for wire, pieces in enumerate(self._pieces):
            if len(pieces) > _PIECES:
                raise Lost(f"lockstep: {len(pieces)} pieces on one wire in one tick, more than {_PIECES}")
            for i, (end, at_ns) in enumerate(pieces, wire * _PIECES):
                piece_end[i], arrival_ns[i] = end, at_ns
        counts = [len(pieces) for pieces in self._pieces]
        tick = _TICK.make(
            seq=self._tick + 1, stamp_ns=self.target_ns, tick=self._tick, piece_end=piece_end, piece_arrival_ns=arrival_ns,
            pieces=counts, last=int(last),
        )  # fmt: skip
        for pieces in self._pieces:
            pieces.clear()
        self._put_tick(_TICK.pack(tick))


class Follower(Lockstep):
    """Every process but the plant."""

    def __init__(self, config: PaceConfig, wire: Wire, stop: Stop, others: Collection[str]) -> None:
        super().__init__(config, wire, stop, others)
        self.rig_clock.on_sleep = self._sleep_until
        self.tick: Any = None
        self._pieces: dict[int, deque[tuple[int, int]]] = {}
        self._inputs: list[tuple[str, int]] = []

    def begin(self) -> None:
        self.say(HELLO)
        self.meet(self.others, lambda: self.say(HELLO))

    def keep_up(self, take: Callable[[], object]) -> None:
        newest = self.board.tick
        all_ended = self.board.ended.keys() >= set(self.others)
        take()
        if newest is None:
            self.say(HELLO)
        else:
            self.say(WATERMARK, int(newest.tick) + 1)
        if all_ended:
            self.say(END)

    def finish(self) -> None:
        if self.over:
            self._mark_done()
        super().finish()

    def _mark_done(self) -> None:
        if self.tick is not None:
            self.say(WATERMARK, int(self.tick.tick) + 1)

    def next_tick(self) -> bool:
        """Be done with the tick in hand and wait for the next; False when none follows, or when asked to stop."""
        if self.tick is not None and self.tick.last:
            self.end()
            return False
        self._mark_done()
        after = 0 if self.tick is None else int(self.tick.seq)
        there = self.board.wait(
            lambda: self.board.tick is not None and self.board.tick.seq > after,
            lambda: f"'{PLANT}'",
            None if after else lambda: self.say(HELLO),
            PATIENCE[PLANT],
        )
        if there:
            self._take(self.board.tick)
        return there

    def _take(self, tick: Any) -> None:
        self.tick = tick
        for wire, waiting in self._pieces.items():
            first = wire * _PIECES
            waiting.extend((tick.piece_end[i], tick.piece_arrival_ns[i]) for i in range(first, first + tick.pieces[wire]))
        if not any(self._pieces.values()):
            self.rig_clock.set(tick.stamp_ns)

    def end_with_this(self) -> None:
        """For a loop that takes one turn a tick: on the last one it is not to begin another."""
        if self.tick is not None and self.tick.last:
            self.end()

    def _sleep_until(self, deadline_ns: int) -> None:
        while self.clock.now_ns() < deadline_ns and not self.stop and self.next_tick():
            pass
        if self.stop:
            self.rig_clock.set(deadline_ns)
            return
        for process, lag in self._inputs:
            self.board.wait_done(process, int(self.tick.tick) + 1 - lag)
        self.end_with_this()

    def awaited(self, take: Callable[[float], Any], what: str) -> Any:
        """What is announced and must come; None when asked to stop. Raises Lost when it does not come."""
        end_s = time.monotonic() + self.timeout_s
        while not self.interrupted():
            found = take(_LOOK_S)
            if found is not None:
                return found
            if time.monotonic() >= end_s:
                raise Lost(f"lockstep: {what} does not arrive, waited {self.timeout_s:g} s")
        return None

    def pieces_of(self, wire: int) -> deque[tuple[int, int]]:
        """The pieces of a wire that were announced and not taken yet: (frames or bytes up to its end, arrival)."""
        return self._pieces.setdefault(wire, deque())

    def frames(self, source: FrameSource, wire: int) -> FrameSource:
        return PacedFrames(self, source, wire)

    def bytes(self, source: ByteSource, wire: int) -> ByteSource:
        return PacedBytes(self, source, wire)

    def commands(self, source: Queue) -> Queue:
        self.board.follow(CONTROLLER)
        return PacedCommands(self, source)

    def requests(self, source: Inbox) -> Requests:
        return PacedRequests(self, source)

    def hear_out(self, process: str, lag: int = 0) -> None:
        self.board.follow(process)
        self._inputs.append((process, lag))

    def newest(self, source: Newest, process: str, lag: int = 0) -> Newest:
        self.hear_out(process, lag)
        return PacedNewest(self, source, process)
