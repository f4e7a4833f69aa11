"""One rig clock on several hosts: the controller's host answers what its clock says, the others follow it.

The launcher of each other host asks over Zenoh, estimates the offset and says it on the channel `clock`; the processes of that
host add it to the machine's monotonic clock. So all stamps and ages of a bench are of one clock, known to a stated uncertainty,
and the processes of one host agree among each other to the nanosecond.
"""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh

from softloop.wire.channels import CLOCK, key, time_key
from softloop.wire.clock import Clock, WallClock
from softloop.wire.clock_config import ClockConfig
from softloop.wire.clock_offset import Change, Estimate, Exchange, OffsetEstimator
from softloop.wire.errors import Unavailable
from softloop.wire.messages import BadPayload, message
from softloop.wire.session import Wire

_CLOCK = message("ClockOffset")
_ANSWER = struct.Struct("<qq")
SLEW_PPM = 1000  # how fast a clock is led to a better estimate; it never goes backward by that
SNAP_NS = 5_000_000  # an estimate that far away is taken at once
ANSWER_S = 0.5
_POLL_S = 0.02


class TimeServer:
    """Answers what a clock says while it is kept."""

    def __init__(self, wire: Wire, clock: Clock | None = None) -> None:
        self._now_ns = (clock or WallClock()).now_ns
        handler = zenoh.handlers.Callback(self._answer, indirect=False)
        self._queryable = wire.session.declare_queryable(time_key(wire.bench), handler)

    def _answer(self, query: Any) -> None:
        heard_ns = self._now_ns()
        with query:
            query.reply(query.key_expr, _ANSWER.pack(heard_ns, self._now_ns()))


class TimeQuestion:
    """Asks for the time, one question after the other."""

    def __init__(self, wire: Wire, clock: Clock | None = None) -> None:
        self._session, self._key = wire.session, time_key(wire.bench)
        self._now_ns = (clock or WallClock()).now_ns

    def ask(self, timeout_s: float = ANSWER_S) -> Exchange | None:
        """One exchange; None when nobody answers in time, or when more than one does."""
        answers: list[tuple[bytes, int]] = []
        over = threading.Event()

        def take(reply: Any) -> None:
            now_ns = self._now_ns()
            if reply.ok is not None:
                answers.append((reply.ok.payload.to_bytes(), now_ns))

        handler = zenoh.handlers.Callback(take, drop=over.set, indirect=False)
        asked_ns = self._now_ns()
        self._session.get(
            self._key, handler, timeout=timeout_s, priority=zenoh.Priority.REAL_TIME,
            consolidation=zenoh.ConsolidationMode.NONE, congestion_control=zenoh.CongestionControl.DROP,
        )  # fmt: skip
        over.wait(2.0 * timeout_s)
        if len(answers) != 1 or len(answers[0][0]) != _ANSWER.size:
            return None
        heard_ns, replied_ns = _ANSWER.unpack(answers[0][0])
        return Exchange(asked_ns, heard_ns, replied_ns, answers[0][1])


class Follower:
    """A host's knowledge of the rig clock, led gently to each better estimate.

    Attributes:
        offset_ns: what the host's processes add to the monotonic clock.
    """

    def __init__(self, config: ClockConfig, host: int) -> None:
        """`host`: its place among the bench's hosts."""
        self.host = host
        self.estimator = OffsetEstimator(config.drift_max_ppm, round(config.step_min_ms * 1e6))
        self.offset_ns = self._step_ns = self._seq = 0
        self._led_ns = 0
        self._moved_ns = 0

    def learn(self, exchange: Exchange) -> Change:
        """Take one exchange, and lead the offset."""
        change = self.estimator.add(exchange)
        if self.estimator.known:
            self._step_ns = change.step_ns or self._step_ns
            self._lead(exchange.answered_ns)
        return change

    def _lead(self, own_ns: int) -> None:
        away_ns = self.estimator.at(own_ns).offset_ns - self.offset_ns
        limit_ns = max(0, own_ns - self._led_ns) * SLEW_PPM // 1_000_000
        first = self._led_ns == 0
        self._moved_ns = away_ns if first or abs(away_ns) > SNAP_NS else max(-limit_ns, min(limit_ns, away_ns))
        self.offset_ns += self._moved_ns
        self._led_ns = own_ns
        if first or abs(self._moved_ns) > SNAP_NS:
            self._moved_ns = 0

    def uncertainty_ns(self, own_ns: int) -> int:
        """The true offset is not farther than this from `offset_ns`, nor from what a process between two words of ours has."""
        known = self.estimator.at(own_ns)
        return known.uncertainty_ns + abs(known.offset_ns - self.offset_ns) + abs(self._moved_ns)

    def word(self, own_ns: int) -> bytes:
        """The next `ClockOffset`."""
        self._seq += 1
        known: Estimate = self.estimator.at(own_ns)
        drifts = abs(known.drift_ppm) - known.drift_error_ppm > self.estimator.drift_max_ppm
        said = _CLOCK.make(
            seq=self._seq, stamp_ns=own_ns + self.offset_ns, offset_ns=self.offset_ns, estimate_ns=known.offset_ns,
            uncertainty_ns=self.uncertainty_ns(own_ns), delay_ns=known.delay_ns, drift_ppm=known.drift_ppm,
            drift_error_ppm=known.drift_error_ppm, exchanges=self.estimator.exchanges, steps=self.estimator.steps,
            step_ns=self._step_ns, host=self.host, drifts=int(drifts),
        )  # fmt: skip
        return _CLOCK.pack(said)


class HostClock:
    """The rig clock on a host that does not keep it: the machine's clock and the host's offset, as its launcher says it.

    A changed offset is taken over slowly, so that the clock never runs backward; one that jumped is taken over at once.
    """

    def __init__(self, host: int, own_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.host, self._own_ns = host, own_ns
        self._line = (0, 0, 0)  # own time, offset then, and the offset that it is led to
        self.known = False

    def listen(self, wire: Wire) -> None:
        """Follow the launcher's word from now on."""
        handler = zenoh.handlers.Callback(self._hear, indirect=False)
        self._subscriber = wire.session.declare_subscriber(key(wire.bench, CLOCK), handler)

    def _hear(self, sample: zenoh.Sample) -> None:
        self.take(sample.payload.to_bytes())

    def take(self, payload: bytes) -> None:
        """A word on the channel `clock`; only that on this host counts."""
        try:
            word = _CLOCK.unpack(payload)
        except BadPayload:
            return
        if word.host == self.host:
            self.set(int(word.offset_ns))

    def set(self, offset_ns: int) -> None:
        """Go over to an offset."""
        own_ns = self._own_ns()
        now_ns = self._offset_at(own_ns)
        at_once = not self.known or abs(offset_ns - now_ns) > SNAP_NS
        self._line = (own_ns, offset_ns if at_once else now_ns, offset_ns)
        self.known = True

    def _offset_at(self, own_ns: int) -> int:
        since_ns, offset_ns, wanted_ns = self._line
        limit_ns = max(0, own_ns - since_ns) * SLEW_PPM // 1_000_000
        return offset_ns + max(-limit_ns, min(limit_ns, wanted_ns - offset_ns))

    def now_ns(self) -> int:
        own_ns = self._own_ns()
        return own_ns + self._offset_at(own_ns)

    def sleep_until_ns(self, deadline_ns: int) -> None:
        left_ns = deadline_ns - self.now_ns()
        if left_ns > 0:
            time.sleep(left_ns * 1e-9)

    def wait_known(self, stop: Callable[[], bool], timeout_s: float = 10.0) -> None:
        """Return once the launcher has said the offset. Raises Unavailable when it does not in time."""
        end_s = time.monotonic() + timeout_s
        while not self.known and not stop():
            if time.monotonic() >= end_s:
                raise Unavailable("nothing is heard of this host's clock: is its launcher (softloop run --host) running?")
            time.sleep(_POLL_S)
