"""A launcher among those of a bench's other hosts: what each says, what is missing, whose clock is sure, and who ends the run.

The host of the controller leads: it waits until all are there, arms, ends the run, and keeps the rig clock. The others start
their share, follow its clock, and stop when it says so, or when nothing is heard of it any more.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

import zenoh

from softloop.deploy.bench import Bench
from softloop.deploy.hosts import launcher_name, leader, number_of, shares
from softloop.deploy.node import PROCESSES, processes_of
from softloop.wire.channels import CLOCK, HOST, host_key
from softloop.wire.clock import Clock, WallClock
from softloop.wire.errors import EXIT_INTERRUPTED, EXIT_LOST, EXIT_USAGE
from softloop.wire.host_clock import Follower, HostClock, TimeQuestion, TimeServer
from softloop.wire.messages import BadPayload, constant, message
from softloop.wire.session import Wire

_STATUS, _CLOCK = message("HostStatus"), message("ClockOffset")
STARTING, READY, RUNNING, TROUBLE, STOPPING = (
    constant("HostStatus", f"STATE_{s}") for s in ("STARTING", "READY", "RUNNING", "TROUBLE", "STOPPING")
)
STEP, DRIFT, UNSURE, SURE = (constant("Event", f"CLOCK_{c}") for c in ("STEP", "DRIFT", "UNSURE", "SURE"))
_SOURCES = {constant("Event", p.source): p.name for p in PROCESSES}
_WORD_S = 1.0 / HOST.rate_hz
_POLL_S = 0.05
_ASK_S = 1.0  # all answer within some ms, but for a machine that is very busy
CLOCK_SILENT_S = 5.0
QUIET_S = 0.8  # four words that are missing: less than `deploy.launcher` waits for the gate
JUDGED_S = 1.5  # after this it is known whether a FAULT came of a host that is not heard
SEEN_S = 3.0  # who was alive so lately is: a busy machine answers late

Ending = tuple[int, str]  # exit code, and one line


class Alone:
    """A bench of one host: its launcher has nobody to wait for."""

    host = ""
    leads = True
    number = 0
    judged_s = 0.0  # for so long a FAULT may still turn out to come of a host that is not heard

    def __init__(self) -> None:
        self.clock: Clock = WallClock()

    def has(self, process: str) -> bool:
        """It is started here."""
        return True

    def say(self, state: int, code: int = 0, lost: int = 0) -> None:
        """How this host is from now on."""

    def missing(self) -> list[str]:
        """What the run still needs of other hosts, in words."""
        return []

    def quiet(self) -> list[tuple[int, str]]:
        """Number and name of the hosts that were heard in this run, and are not now."""
        return []

    def look(self) -> None:
        """Take what the others said."""

    def trouble(self, *, excused: bool = False) -> Ending | None:
        """Why the run cannot go on, as far as other hosts are concerned; `excused`: silence is no reason."""
        return None

    def await_gone(self, processes: Collection[str], timeout_s: float) -> None:
        """Wait until these have ended on other hosts."""

    def linger(self, timeout_s: float) -> None:
        """Be there for the others until they have ended."""

    def close(self) -> None:
        """Say no more."""


@dataclass
class Seen:
    """The newest word of another launcher, when it was heard, and whether it belongs to this run."""

    word: Any
    heard_s: float
    joined: bool


@dataclass
class SeenClock:
    """The newest word on another host's clock, when it was heard, and what was made an event of it."""

    word: Any
    heard_s: float
    steps: int = 0
    drifts: bool = False
    unsure: bool = False


class Fleet(Alone):
    """A launcher on one of several hosts.

    `on_clock` is told of what happens to another host's clock: CLOCK_*, host number, value.
    """

    judged_s = JUDGED_S

    def __init__(
        self, bench: Bench, host: str, wire: Wire, digest: int, on_clock: Callable[[int, int, float], None] = lambda *_: None
    ) -> None:
        super().__init__()
        self.bench, self.host, self.wire, self.on_clock = bench, host, wire, on_clock
        self.leader = leader(bench)
        self.leads = host == self.leader
        self.number = number_of(bench, host)
        running = {p.name for p in processes_of(bench)}
        self.shares = {name: [p for p in processes if p in running] for name, processes in shares(bench).items()}
        self._hosts = sorted(bench.hosts)
        self._digest, self._origin, self._seq = digest, secrets.randbits(63), 0
        self._word = (STARTING, 0, 0)
        self._seen: dict[str, Seen] = {}
        self._clocks: dict[int, SeenClock] = {}
        self._alive_s: dict[str, float] = {}
        self._closed = threading.Event()
        self._wall = bench.pace.mode == "wall"
        self._put = wire.declare_publisher(host_key(bench.name, host), realtime=False).put
        handler = zenoh.handlers.Callback(self._hear, indirect=False)
        self._subscriber = wire.session.declare_subscriber(host_key(bench.name, "*"), handler)
        self._clock_words = wire.inbox(CLOCK)
        self._follower, self._question = Follower(bench.clock, self.number), TimeQuestion(wire)
        self._server = TimeServer(wire) if self.leads else None
        self._host_clock = HostClock(self.number)
        if self._wall and not self.leads:
            self.clock = self._host_clock
        self._put_clock = wire.publisher(CLOCK)
        self._thread = threading.Thread(target=self._keep_speaking, name="fleet", daemon=True)
        self._thread.start()

    def _hear(self, sample: zenoh.Sample) -> None:
        name = str(sample.key_expr).rsplit("/", 1)[1]
        try:
            word = _STATUS.unpack(sample.payload.to_bytes())
        except BadPayload:
            return
        if name == self.host or name not in self._hosts:
            return
        before = self._seen.get(name)
        joined = word.state != STOPPING or (before is not None and before.joined and before.word.origin == word.origin)
        if joined:  # what a launcher of an earlier run says at its end is not for us
            self._seen[name] = Seen(word, time.monotonic(), joined)

    def _keep_speaking(self) -> None:
        next_word_s = 0.0
        period_s = self.bench.clock.period_ms * 1e-3
        while not self._closed.is_set():
            if self._wall and not self.leads:
                self._follow_clock()
            if time.monotonic() >= next_word_s:
                next_word_s = time.monotonic() + _WORD_S
                self._speak()
            self._closed.wait(min(period_s, _WORD_S))

    def _follow_clock(self) -> None:
        exchange = self._question.ask()
        if exchange is not None:
            self._follower.learn(exchange)
        if self._follower.estimator.known:
            self._put_clock(self._follower.word(time.monotonic_ns()))
            self._host_clock.set(self._follower.offset_ns)

    def _speak(self) -> None:
        self._seq += 1
        state, code, lost = self._word
        word = _STATUS.make(
            seq=self._seq,
            stamp_ns=self.clock.now_ns(),
            origin=self._origin,
            digest=self._digest,
            state=state,
            code=code,
            lost=lost,
        )
        self._put(_STATUS.pack(word))

    @property
    def clock_known(self) -> bool:
        """What time it is is known here."""
        return self.leads or not self._wall or self._host_clock.known

    @property
    def leader_there(self) -> bool:
        """The host that leads was heard in this run, and lately."""
        return self._is_there(self.leader)

    def has(self, process: str) -> bool:
        return process in self.shares[self.host]

    def say(self, state: int, code: int = 0, lost: int = 0) -> None:
        self._word = (state, code, lost)
        self._speak()

    def _is_there(self, host: str) -> bool:
        seen = self._seen.get(host)
        return seen is not None and time.monotonic() - seen.heard_s < self.bench.run.host_silence_s

    def missing(self) -> list[str]:
        alive = self._alive_lately()
        words: list[str] = []
        for host in self._hosts:
            if host != self.host:
                words += self._missing_of(host, alive)
        return words

    def _alive_lately(self) -> set[str]:
        """Whose sign of life was there a moment ago."""
        now_s = time.monotonic()
        self._alive_s.update(dict.fromkeys(self.wire.processes_alive(timeout_s=_ASK_S), now_s))
        return {name for name, seen_s in self._alive_s.items() if now_s - seen_s < SEEN_S}

    def _missing_of(self, host: str, alive: Collection[str]) -> list[str]:
        if not self._is_there(host):
            return [f"host '{host}' ({', '.join(self.shares[host])}), which is not started"]
        gone = [name for name in self.shares[host] if name not in alive]
        if gone:
            return [f"{', '.join(gone)} on host '{host}'"]
        if self.leads and self._wall and self._unsure(number_of(self.bench, host)):
            return [self._clock_text(host)]
        if self.leads and self._seen[host].word.state == STARTING:
            return [f"host '{host}', which is still starting"]
        if host == self.leader and self._seen[host].word.state != RUNNING:
            return [f"the word of host '{host}', which leads"]
        return []

    def quiet(self) -> list[tuple[int, str]]:
        if not self.leads or self._word[0] != RUNNING:
            return []
        now_s = time.monotonic()
        silent = [host for host, seen in list(self._seen.items()) if now_s - seen.heard_s > QUIET_S]
        return [(number_of(self.bench, host), host) for host in silent]

    def _unsure(self, number: int) -> bool:
        seen = self._clocks.get(number)
        silent = seen is None or time.monotonic() - seen.heard_s > CLOCK_SILENT_S
        return silent or seen is None or seen.word.uncertainty_ns > self.bench.clock.uncertainty_max_ms * 1e6

    def _clock_text(self, host: str) -> str:
        seen = self._clocks.get(number_of(self.bench, host))
        if seen is None:
            return f"the clock of host '{host}', of which nothing is known"
        known_ms, limit_ms = seen.word.uncertainty_ns * 1e-6, self.bench.clock.uncertainty_max_ms
        return f"the clock of host '{host}', known to {known_ms:.3g} ms ([clock] uncertainty_max_ms = {limit_ms:g})"

    def look(self) -> None:
        for _, payload in self._clock_words.take_all():
            try:
                word = _CLOCK.unpack(payload)
            except BadPayload:
                continue
            if self.leads and word.host < len(self._hosts):
                self._note_clock(word)

    def _note_clock(self, word: Any) -> None:
        seen = self._clocks.setdefault(word.host, SeenClock(word, 0.0, steps=int(word.steps), unsure=True))
        seen.word, seen.heard_s = word, time.monotonic()
        if word.steps > seen.steps:
            self.on_clock(STEP, word.host, word.step_ns * 1e-6)
        if word.drifts and not seen.drifts:
            self.on_clock(DRIFT, word.host, word.drift_ppm)
        unsure = word.uncertainty_ns > self.bench.clock.uncertainty_max_ms * 1e6
        if unsure != seen.unsure:
            self.on_clock(UNSURE if unsure else SURE, word.host, word.uncertainty_ns * 1e-6)
        seen.steps, seen.drifts, seen.unsure = int(word.steps), bool(word.drifts), unsure

    def trouble(self, *, excused: bool = False) -> Ending | None:
        self.look()
        for host, seen in list(self._seen.items()):
            if self.leads or host == self.leader:
                ending = self._word_of(host, seen) or (None if excused else self._silence_of(host, seen))
                if ending is not None:
                    return ending
        return None

    def _word_of(self, host: str, seen: Seen) -> Ending | None:
        word = seen.word
        if word.digest != self._digest:
            return EXIT_USAGE, f"host '{host}' has another bench file, or another version of softloop"
        if word.state == STOPPING and (word.code or host == self.leader):
            return self._ended(host, int(word.code))
        if word.state == TROUBLE:
            name = _SOURCES.get(word.lost)
            what = f"lost process '{name}'" if name else "was interrupted" if word.code == EXIT_INTERRUPTED else "cannot go on"
            return int(word.code) or EXIT_LOST, f"host '{host}' {what}; it says there why"
        return None

    def _silence_of(self, host: str, seen: Seen) -> Ending | None:
        if time.monotonic() - seen.heard_s > self.bench.run.host_silence_s:
            left = f"nothing heard of its launcher for {self.bench.run.host_silence_s:g} s"
            return EXIT_LOST, f"host '{host}' ({', '.join(self.shares[host])}) is lost: {left}"
        if self.leads and self._wall and self._word[0] == RUNNING and self._unsure(number_of(self.bench, host)):
            return EXIT_LOST, f"stamps cannot be compared any more: {self._clock_text(host)}"
        return None

    def _ended(self, host: str, code: int) -> Ending:
        if host == self.leader and code == 0:
            return 0, f"the run is over, says host '{host}'"
        return code or EXIT_LOST, f"host '{host}' ended the run with code {code}"

    @property
    def leader_ended(self) -> bool:
        """The host that leads has ended the run."""
        seen = self._seen.get(self.leader)
        return seen is not None and seen.word.state == STOPPING

    def await_gone(self, processes: Collection[str], timeout_s: float) -> None:
        self._await_none({name for name in processes if not self.has(name)}, timeout_s)

    def linger(self, timeout_s: float) -> None:
        if self.leads:
            self._await_none({launcher_name(self.bench, host) for host in self._hosts if host != self.host}, timeout_s)

    def _await_none(self, names: set[str], timeout_s: float) -> None:
        end_s = time.monotonic() + timeout_s
        while names & self.wire.processes_alive(timeout_s=_ASK_S) and time.monotonic() < end_s:
            time.sleep(_POLL_S)

    def close(self) -> None:
        self._closed.set()
        self._thread.join()
