"""The offset between two clocks from exchanges over a network, with a bound on its error. Pure: no clock is read here.

An exchange is NTP's: asked at t1 and answered at t4 by the own clock, heard at t2 and replied at t3 by the reference clock.
Both ways take some time that is not known, but neither takes less than none, so the true offset lies within half the round
trip of the middle, however unequal the two ways are; how far the clocks can have run apart since comes on top. What is known
is the range within the bounds of all of the last exchanges: one that waited on its way there and one on its way back say more
together than each alone.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

WINDOW = 64  # exchanges that are remembered
RATE_SPAN_NS = 1_000_000_000  # for the clocks' rate, the best exchange of each such span is kept
RATE_SPANS = 64
# What the middle of an exchange may move by itself where its round trip says that it did not: reading clocks takes time.
SHIFT_NS = 50_000
QUICK = 1.5  # times the shortest round trip of the last minute: as good a witness
# What bridges a gap at this rate or less since the last exchange is drift; what does not has jumped.
PLAUSIBLE_PPM = 2000.0
READING_NS = 1_000  # two clocks are not read in the very same instant


@dataclass(frozen=True)
class Exchange:
    """One question and its answer, ns: asked and answered by the own clock, heard and replied by the reference clock."""

    asked_ns: int
    heard_ns: int
    replied_ns: int
    answered_ns: int

    @property
    def offset_ns(self) -> int:
        """Reference clock less own clock, as if both ways took as long."""
        return (self.heard_ns - self.asked_ns + self.replied_ns - self.answered_ns) // 2

    @property
    def delay_ns(self) -> int:
        """Time on both ways together."""
        return self.answered_ns - self.asked_ns - (self.replied_ns - self.heard_ns)

    @property
    def possible(self) -> bool:
        """No way took less than no time, and nothing was answered before it was asked."""
        return self.delay_ns >= 0 and self.answered_ns >= self.asked_ns and self.replied_ns >= self.heard_ns


@dataclass(frozen=True)
class Estimate:
    """What is known of a clock at one time.

    Attributes:
        offset_ns: reference clock less own clock, the middle of the range that it must lie in.
        uncertainty_ns: the true offset is not farther away than this.
        delay_ns: round trip of the exchange that says most by itself.
        drift_ppm: how much faster the reference clock runs; drift_error_ppm is the bound on its error.
    """

    offset_ns: int
    uncertainty_ns: int
    delay_ns: int
    drift_ppm: float
    drift_error_ppm: float


@dataclass(frozen=True)
class Change:
    """What an exchange showed: a jump of the offset by `step_ns`, or clocks that run apart faster than they may."""

    step_ns: int = 0
    drifts: bool = False


class OffsetEstimator:
    """Takes exchanges in the order of their answers; `at` says what is known."""

    def __init__(self, drift_max_ppm: float, step_min_ns: int) -> None:
        self.drift_max_ppm, self.step_min_ns = drift_max_ppm, step_min_ns
        self.exchanges = self.steps = 0
        self._rate_ppm = drift_max_ppm  # by which the bound grows; more than allowed once the clocks were seen to do more
        self._recent: deque[Exchange] = deque(maxlen=WINDOW)
        self._spans: deque[Exchange] = deque(maxlen=RATE_SPANS)
        self._drifting = False

    @property
    def known(self) -> bool:
        return bool(self._recent)

    def add(self, exchange: Exchange) -> Change:
        """Learn from one exchange. One that cannot be (answered before asked) is left out."""
        if not exchange.possible:
            return Change()
        self.exchanges += 1
        step_ns = self._check(exchange) if self._recent else 0
        self._recent.append(exchange)
        self._keep_for_rate(exchange)
        return Change(step_ns, self._begins_to_drift())

    def at(self, own_ns: int) -> Estimate:
        """What is known at `own_ns`. Needs one exchange at least."""
        low_ns, high_ns = self._range_ns(own_ns)
        drift_ppm, error_ppm = self._drift()
        middle_ns, half_ns = (low_ns + high_ns) // 2, (high_ns - low_ns + 1) // 2
        return Estimate(middle_ns, half_ns, self._best(own_ns).delay_ns, drift_ppm, error_ppm)

    def _range_ns(self, own_ns: int) -> tuple[int, int]:
        """Where the true offset lies at `own_ns`, by all exchanges that are remembered; none of them speaks against it."""
        bounds = [(e.offset_ns, self._bound_ns(e, own_ns)) for e in self._recent]
        return max(o - b for o, b in bounds), min(o + b for o, b in bounds)

    def _best(self, own_ns: int) -> Exchange:
        return min(self._recent, key=lambda e: self._bound_ns(e, own_ns))

    def _bound_ns(self, exchange: Exchange, own_ns: int) -> int:
        """How far from an exchange's offset the true one can be at `own_ns`."""
        return exchange.delay_ns // 2 + self._moved_ns(exchange.asked_ns, own_ns) + READING_NS

    def _moved_ns(self, from_ns: int, to_ns: int) -> int:
        return round(abs(to_ns - from_ns) * self._rate_ppm * 1e-6)

    def _check(self, new: Exchange) -> int:
        """Forget what the new exchange speaks against; returns by how much the clock jumped, 0 where it did not."""
        now_ns = new.answered_ns
        low_ns, high_ns = self._range_ns(now_ns)
        bound_ns = self._bound_ns(new, now_ns)
        gap_ns = max(new.offset_ns - bound_ns - high_ns, low_ns - new.offset_ns - bound_ns)
        if gap_ns > 0:  # both cannot be true of one clock
            return self._contradicted(new, new.offset_ns - (low_ns + high_ns) // 2, gap_ns)
        best = self._best(now_ns)
        if self._is_quick(new) and abs(new.offset_ns - best.offset_ns) > self._may_shift_ns(best, new):
            self._recent.clear()  # both may be true, but either the way or the clock is another now
        return 0

    def _is_quick(self, new: Exchange) -> bool:
        """One that waited long knows little: it may not make what is known better forgotten."""
        return new.delay_ns <= QUICK * self._shortest_ns(new) + SHIFT_NS

    def _shortest_ns(self, new: Exchange) -> int:
        """The shortest round trip of the last minute; in some seconds of a busy machine all may have waited."""
        return min(e.delay_ns for e in (*self._recent, *self._spans, new))

    def _contradicted(self, new: Exchange, apart_ns: int, gap_ns: int) -> int:
        since_ns = max(1, new.answered_ns - self._recent[-1].answered_ns)
        self._recent.clear()
        if gap_ns <= since_ns * PLAUSIBLE_PPM * 1e-6 and abs(apart_ns) < self.step_min_ns:
            self._rate_ppm = min(2.0 * self._rate_ppm, max(PLAUSIBLE_PPM, self.drift_max_ppm))
            return 0
        self._spans.clear()
        if abs(apart_ns) < self.step_min_ns:
            return 0
        self.steps += 1
        return apart_ns

    def _may_shift_ns(self, best: Exchange, new: Exchange) -> float:
        """How far two middles can be apart on ways whose shortest times stand: what queues add goes to one side only."""
        shortest_ns = self._shortest_ns(new)
        queued_ns = (best.delay_ns - shortest_ns + new.delay_ns - shortest_ns) / 2
        return queued_ns + self._moved_ns(best.asked_ns, new.answered_ns) + SHIFT_NS

    def _keep_for_rate(self, new: Exchange) -> None:
        if self._spans and new.answered_ns - self._spans[-1].answered_ns < RATE_SPAN_NS:
            if new.delay_ns < self._spans[-1].delay_ns:
                self._spans[-1] = new
        else:
            self._spans.append(new)

    def _drift(self) -> tuple[float, float]:
        """How much faster the reference clock runs, and the bound on the error of that, ppm."""
        if len(self._spans) < 2:
            return 0.0, self._rate_ppm
        spans = list(self._spans)
        some = max(1, len(spans) // 4)
        first = min(spans[:some], key=lambda e: e.delay_ns)
        last = min(spans[-some:], key=lambda e: e.delay_ns)
        over_ns = max(1, last.asked_ns - first.asked_ns)
        error_ns = (first.delay_ns + last.delay_ns) / 2 + READING_NS
        return (last.offset_ns - first.offset_ns) / over_ns * 1e6, error_ns / over_ns * 1e6

    def _begins_to_drift(self) -> bool:
        """The clocks are known to run apart faster than they may; said once, until they are known not to."""
        drift_ppm, error_ppm = self._drift()
        too_fast = abs(drift_ppm) - error_ppm > self.drift_max_ppm
        if too_fast:
            self._rate_ppm = max(self._rate_ppm, abs(drift_ppm) + error_ppm)
        began = too_fast and not self._drifting
        slow = abs(drift_ppm) + error_ppm <= self.drift_max_ppm
        self._drifting = too_fast or (self._drifting and not slow)
        return began
