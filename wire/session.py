"""Zenoh as softloop uses it: sessions, latest-sample inputs, publishers that never wait."""

from __future__ import annotations

import secrets
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zenoh

from softloop.wire.backlog import Backlog
from softloop.wire.channels import ROOT, Channel, alive_key, key, node_of
from softloop.wire.config import SECURED, ZenohConfig
from softloop.wire.errors import Unavailable
from softloop.wire.identity import Identity, identity_of
from softloop.wire.rights import RIGHTS, ROUTER
from softloop.wire.zenoh_settings import UNIX, make_config, own_endpoint

SETTLED_S = 0.3  # no link came or went for so long
SETTLE_AT_MOST_S = 3.0
LAST_WORDS_S = 0.3  # QUIC sends again after some 30 ms, then 60 and 120, on a way of a few ms


def open_session(config: ZenohConfig, bench: str, process: str) -> zenoh.Session:
    """A session of one process on a bench. Raises Unavailable when it cannot listen, or has no good identity."""
    return _open_as(_known(config, bench, process), config, bench, process)


def _known(config: ZenohConfig, bench: str, process: str) -> Identity | None:
    """Who this is; what is soon to be wrong with that is said."""
    identity = identity_of(config, bench, process)
    if identity is not None and identity.warning:
        sys.stderr.write(f"[{process}] {identity.warning}\n")
    return identity


def _open_as(identity: Identity | None, config: ZenohConfig, bench: str, process: str) -> zenoh.Session:
    meet = config.meeting_point(bench)
    # A person's certificate is none to be connected to.
    peer = config.mode == "peer" and (identity is None or identity.name in RIGHTS)
    listen = [own_endpoint(meet, process, config.listen)] if peer else []
    return _open(make_config("peer" if peer else "client", listen, [meet], config.lease_ms, identity=identity), meet)


def open_router(config: ZenohConfig, bench: str) -> zenoh.Session:
    """The meeting point itself. Raises Unavailable when its address is taken, or it has no good identity."""
    meet = config.meeting_point(bench)
    identity = _known(config, bench, ROUTER)
    return _open(make_config("router", [meet], [], config.lease_ms, identity=identity), meet)


def open_meeting(bench: str, endpoint: str, lease_ms: int = 5000) -> zenoh.Session:
    """A peer for one who comes alone: joins the meeting point, and is it where nobody else is."""
    name = f"guest-{time.monotonic_ns() & 0xFFFFFF:x}"
    config = make_config("peer", [endpoint, own_endpoint(endpoint, name)], [endpoint], lease_ms, listen_must_work=False)
    return _open(config, endpoint)


def _open(config: zenoh.Config, where: str) -> zenoh.Session:
    if where.startswith(UNIX):
        _check_socket_path(where[len(UNIX) :])
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise Unavailable(f"Zenoh endpoint {where}: {_short(error)}{_hint(where, str(error))}") from None


def _hint(where: str, text: str) -> str:
    """Zenoh does not say why a link over TLS does not come about."""
    if not where.startswith(SECURED) or "connect" not in text:
        return ""
    return "; nobody is there, or its certificate is of another authority, expired, or not of this address"


def _check_socket_path(path: str) -> None:
    # sun_path holds 108 bytes with its final zero; a peer's own socket adds its name and pid.
    if len(path) > 70:
        raise Unavailable(f"Zenoh endpoint {UNIX}{path}: a Unix socket's path may have at most 70 characters here")
    if not Path(path).parent.is_dir():
        raise Unavailable(f"Zenoh endpoint {UNIX}{path}: there is no folder {Path(path).parent}")


def _short(error: Exception) -> str:
    text = str(error)
    if any(word in text for word in ("in use", "lock", "Lock", "already")):
        return "the address is in use; is this bench running already?"
    return text.split(" at ", maxsplit=1)[0].splitlines()[0][:200]


class Latest:
    """The newest sample of a channel and nothing older: a ring of depth one."""

    def __init__(self, session: zenoh.Session, key_expr: str) -> None:
        self._subscriber = session.declare_subscriber(key_expr, zenoh.handlers.RingChannel(1))

    def take(self) -> bytes | None:
        """The payload of the newest sample that was not taken yet, or None."""
        sample = self._subscriber.try_recv()
        return None if sample is None else sample.payload.to_bytes()


class Inbox:
    """All samples of a key expression, or of several, in order, with a wake-up: for loops that act on arrival.

    Bounded: when nobody takes, the oldest go and are counted in `dropped`.
    """

    def __init__(self, session: zenoh.Session, *key_exprs: str, capacity: int = 4096) -> None:
        self._items: deque[tuple[str, bytes]] = deque(maxlen=capacity)
        self._ready = threading.Condition()
        self.dropped = self.received = 0
        handler = zenoh.handlers.Callback(self._receive, indirect=False)
        self._subscribers = [session.declare_subscriber(one, handler) for one in key_exprs]

    def _receive(self, sample: zenoh.Sample) -> None:
        with self._ready:
            self.dropped += len(self._items) == self._items.maxlen
            self.received += 1
            self._items.append((str(sample.key_expr), sample.payload.to_bytes()))
            self._ready.notify()

    def take(self, timeout_s: float = 0.0) -> tuple[str, bytes] | None:
        """The oldest (key, payload) waiting, or None after `timeout_s`."""
        if not self._items and timeout_s > 0:
            with self._ready:
                self._ready.wait_for(lambda: bool(self._items), timeout_s)
        try:
            return self._items.popleft()
        except IndexError:
            return None

    def take_all(self) -> list[tuple[str, bytes]]:
        """All (key, payload) waiting, oldest first, without waiting."""
        taken = []
        while self._items:
            taken.append(self._items.popleft())
        return taken


class Wire:
    """One process's end of a bench: publishers, inputs and its sign of life.

    Attributes:
        exact: at lockstep pace: who sends waits for who reads, and equal runs give equal bytes.
        on_put: told of each payload on a channel of the 5 ms path before it is sent.
        spoil: changes how a channel is published, where faults are injected into it.
        identity: who this is on a secured bench. Zenoh refuses in silence; what is asked for here is refused with a word.
    """

    def __init__(
        self, session: zenoh.Session, bench: str, process: str, identity: Identity | None = None, *, datagrams: bool = False
    ) -> None:
        self.session = session
        self._datagrams = datagrams
        self.identity = identity
        self.bench = bench
        self.process = process
        self.exact = False
        self.on_put: Callable[[bytes], None] | None = None
        self.spoil: Callable[[Channel, Callable[[bytes], None]], Callable[[bytes], None]] | None = None
        self._token: Any = None

    def publisher(self, channel: Channel) -> Callable[[bytes], None]:
        """A function that publishes a payload on a channel. At wall pace it never waits: what cannot be sent is dropped.

        Raises Unavailable when this process has no right to.
        """
        if not self.may_put(channel):
            raise self.refused("publish on", channel)
        publisher = self.declare_publisher(key(self.bench, channel), realtime=channel.realtime, sampled=channel.sampled)
        put: Callable[[bytes], None] = publisher.put
        put = self._noted(put) if channel.realtime and self.on_put else put
        return put if self.spoil is None else self.spoil(channel, put)

    def _noted(self, put: Callable[[bytes], None]) -> Callable[[bytes], None]:
        def put_noted(payload: bytes) -> None:
            if self.on_put is not None:
                self.on_put(payload)
            put(payload)

        return put_noted

    def may_put(self, channel: Channel) -> bool:
        """Whether this process has the right to publish on a channel."""
        return self.identity is None or self.identity.rights.may_put(channel.name)

    def refused(self, what: str, channel: Channel) -> Unavailable:
        """What is said where a right is missing."""
        who = "nobody" if self.identity is None else self.identity.name
        return Unavailable(f"identity '{who}' has no right to {what} '{channel.name}' of bench '{self.bench}'")

    def _may_hear(self, channel: Channel) -> None:
        if self.identity is not None and not self.identity.rights.may_hear(channel.name):
            raise self.refused("hear", channel)

    @property
    def congestion(self) -> zenoh.CongestionControl:
        """What a publisher does when a reader is slow."""
        return zenoh.CongestionControl.BLOCK if self.exact else zenoh.CongestionControl.DROP

    def node_on(self, bus: str) -> int:
        """The number of this process among a CAN bus's senders: random, and at lockstep pace the same in each run; not 0."""
        if self.exact:
            return node_of(self.bench, self.process, bus)
        return secrets.randbits(63) + 1

    def declare_publisher(self, full_key: str, *, realtime: bool, sampled: bool = False) -> zenoh.Publisher:
        """`sampled`: the next message is soon there and makes this one old; see `Channel`."""
        return self.session.declare_publisher(
            full_key,
            encoding="application/cdr",
            priority=zenoh.Priority.REAL_TIME if realtime else zenoh.Priority.DATA,
            congestion_control=self.congestion,
            # An express message takes one of the two buffers of its priority for itself: of four put at once two were lost.
            express=False,
            reliability=self._reliability(sampled=sampled),
        )

    def _reliability(self, *, sampled: bool) -> zenoh.Reliability:
        """A sample that is lost is not sent again where a link can do without: the next one would be there before it."""
        lossy = self._datagrams and sampled and not self.exact
        return zenoh.Reliability.BEST_EFFORT if lossy else zenoh.Reliability.RELIABLE

    def latest(self, channel: Channel) -> Latest:
        """The newest sample of a channel: what a control input is. Raises Unavailable without the right to it."""
        self._may_hear(channel)
        return Latest(self.session, key(self.bench, channel))

    def inbox(self, *channels: Channel) -> Inbox:
        """All samples of a channel, or of several, in order, with a wake-up. Raises Unavailable without the right to them."""
        for channel in channels:
            self._may_hear(channel)
        return Inbox(self.session, *(key(self.bench, channel) for channel in channels))

    def everything(self, capacity: int) -> Backlog:
        """All samples of all channels of the bench."""
        return Backlog(self.session, f"{ROOT}/{self.bench}/**", capacity)

    def settle(self, stop: Callable[[], bool]) -> None:
        """Return when the links to the meeting point and to the peers it tells of are up, or after a while without them.

        What is declared in the very moment in which a link comes up can be lost on that link for good (seen in two
        starts of some thirty, six processes at once). So links come first, and declarations on a network that stands still.
        """
        deadline = time.monotonic() + SETTLE_AT_MOST_S
        known: set[str] = set()
        steady_since = time.monotonic()
        while not stop() and time.monotonic() < deadline:
            now = {str(zid) for zid in (*self.session.info.routers_zid(), *self.session.info.peers_zid())}
            if now != known or not now:
                known, steady_since = now, time.monotonic()
            elif time.monotonic() - steady_since > SETTLED_S:
                return
            time.sleep(0.02)

    def declare_alive(self) -> None:
        """Show on the network that this process runs, until its session closes."""
        self._token = self.session.liveliness().declare_token(alive_key(self.bench, self.process))

    def take_leave(self) -> None:
        """Say that this process ends, and over QUIC wait until that and all that was said before is there.

        TCP sends again what a network lost after a session was closed, QUIC does not: others would take this process for alive
        until its link's lease ends.
        """
        if self._token is not None:
            self._token.undeclare()
            self._token = None
        if self._datagrams:
            time.sleep(LAST_WORDS_S)

    def processes_alive(self, timeout_s: float = 0.5) -> set[str]:
        """Names of the processes of this bench that are alive now."""
        replies = self.session.liveliness().get(alive_key(self.bench, "*"), timeout=timeout_s)
        return {str(r.ok.key_expr).rsplit("/", 1)[1] for r in replies if r.ok}


@contextmanager
def open_wire(config: ZenohConfig, bench: str, process: str) -> Iterator[Wire]:
    """A `Wire` whose session is closed at the end, whatever happened."""
    identity = _known(config, bench, process)
    with _open_as(identity, config, bench, process) as session:
        wire = Wire(session, bench, process, identity, datagrams=config.datagrams)
        try:
            yield wire
        finally:
            wire.take_leave()
