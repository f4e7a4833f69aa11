"""CAN over Zenoh: python-can's interface `zenoh`, a bus between processes where the kernel has no CAN.

`can.Bus(interface="zenoh", channel="can0")` works in any process: those of one user meet at a Unix socket, with no router.
Each frame is a `CanFrame` message on a key of its own, `softloop/<bench>/can/<channel>/<id>`. There is no arbitration, no
bit time and no acknowledgement: what is sent arrives at once at all other buses of the channel, or, when a reader stalls,
is dropped and never waited for. With `through_bus` it goes to the one who holds the channel as a bus in time (`can_owner`)
instead, comes to all others from there, and error frames are heard that are this node's own. `bus.lost` counts the gaps in
the senders' counters, `bus.dropped` what found this bus's own queue full, `bus.malformed` what came on the keys and was no frame.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import re
import secrets
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import can
import zenoh
from can.typechecking import AutoDetectedConfig, CanFilters

from softloop.wire.can_frame import (
    FLAG_ERROR,
    FLAG_EXTENDED,
    FRAME_SIZE,
    CanFrame,
    controller_of,
    from_message,
    make_frame,
    pack_frame,
    state_after,
    to_message,
    unpack_frame,
)
from softloop.wire.can_queue import FrameQueue
from softloop.wire.channels import CAN, ROOT, bus_key, can_key
from softloop.wire.clock import Clock, WallClock
from softloop.wire.config import default_endpoint
from softloop.wire.errors import SoftloopError
from softloop.wire.session import open_meeting
from softloop.wire.zenoh_settings import UNIX

DEFAULT_BENCH = "default"
_CHUNK = re.compile(r"[^/*$?#@\s][^/*$?#\s]*")
_MAX_PUBLISHERS = 2048  # all standard ids; whoever sends more extended ids than that pays for a put by name
_MAX_SENDERS = 1024
_DROP = zenoh.CongestionControl.DROP
_SETTLE_S = 0.02  # measured: links to all others stand 1 to 3 ms after the meeting point answered
_SETTLE_AT_MOST_S = 0.5
_ANSWER_AT_MOST_S = 0.5


class FramePublisher:
    """Puts frames on the keys of one channel; one Zenoh publisher per arbitration id, declared at its first frame.

    Frames are dropped rather than waited for, and are not `express`: an express message takes one of the two buffers of its
    priority for itself, and of four frames handed over at once two were lost, where batched ones all arrived.
    """

    def __init__(
        self,
        session: zenoh.Session,
        bench: str,
        channel: str,
        congestion: zenoh.CongestionControl = _DROP,
        key_of: Callable[[str, str, int], str] = can_key,
    ) -> None:
        """`key_of`: gives the key of (bench, channel, arbitration id)."""
        self._session, self._key_of = session, key_of
        self._bench = bench
        self._channel = channel
        self._publishers: dict[int, zenoh.Publisher] = {}
        self._qos: dict[str, Any] = {
            "encoding": "application/cdr",
            "priority": zenoh.Priority.REAL_TIME,
            "congestion_control": congestion,
            "express": False,
        }

    def put(self, frame: CanFrame) -> None:
        """Publish a frame. Raises zenoh.ZError when the session is closed."""
        publisher = self._publishers.get(frame.arbitration_id)
        if publisher is None:
            key = self._key_of(self._bench, self._channel, frame.arbitration_id)
            if len(self._publishers) >= _MAX_PUBLISHERS:
                self._session.put(key, pack_frame(frame), **self._qos)
                return
            publisher = self._publishers[frame.arbitration_id] = self._session.declare_publisher(key, **self._qos)
        publisher.put(pack_frame(frame))

    def close(self) -> None:
        """Withdraw the publishers, each once no `put` in another thread uses it any more."""
        self._publishers.clear()


class ZenohBus(can.BusABC):
    """A CAN bus over Zenoh.

    Args:
        channel: name of the bus; all who use the same one on the same bench are on one bus.
        can_filters: as python-can has them. Frames that no filter matches are thrown away when they arrive. Error frames
            pass all filters, as on SocketCAN: who filters must still learn of bus-off.
        bench: name of the bench, a part of all keys.
        endpoint: where to meet; empty for the bench's Unix socket in the user's runtime directory.
        session: a Zenoh session to use instead of an own one; it is not closed with the bus.
        receive_own_messages: also receive what this bus sends (with `is_rx` False).
        rx_queue_size: frames kept until they are received; when it is full the oldest go, counted in `dropped`.
        clock: where stamps come from; the machine's monotonic clock unless given.
        node: this bus's number among the senders, not 0; random unless given.
        congestion: wait for slow readers, or drop; drop unless given.
        through_bus: the channel is a bus in time, which somebody on it holds (`[can.NAME.emulation]` of a bench file). Off
            the bus, `send` then raises CanOperationError with ENETDOWN, as on SocketCAN.
        **ignored: whatever else configuration files and other interfaces' users pass (bitrate, timing, ...).

    Raises:
        ValueError: a name that cannot be part of a key, or `fd=True`.
        can.CanInitializationError: the endpoint cannot be used, or the session is closed.

    `send` returns at once and never blocks; its timeout has no meaning here. Timestamps are the rig clock in seconds;
    `recv_frame` gives the frame itself, with integer nanoseconds. Error frames can be sent, to emulate a bus in trouble;
    `state` follows the ones received.
    """

    def __init__(
        self,
        channel: Any = "can0",
        can_filters: CanFilters | None = None,
        *,
        bench: Any = DEFAULT_BENCH,
        endpoint: str = "",
        session: zenoh.Session | None = None,
        receive_own_messages: bool = False,
        rx_queue_size: int = 4096,
        clock: Clock | None = None,
        node: int = 0,
        congestion: zenoh.CongestionControl = _DROP,
        through_bus: bool = False,
        fd: bool = False,
        **ignored: Any,
    ) -> None:
        if fd or isinstance(ignored.get("timing"), can.BitTimingFd):
            raise ValueError("the interface 'zenoh' carries classic CAN frames only, not CAN FD")
        if rx_queue_size < 1:
            raise ValueError(f"rx_queue_size must be at least 1, not {rx_queue_size}")
        self._channel = _chunk("channel", channel)
        self._bench = _chunk("bench", bench)
        self._receive_own = bool(receive_own_messages)
        self._clock: Clock = clock or WallClock()
        self._node = node or random_node()
        self._congestion, self._through_bus = congestion, bool(through_bus)
        self._seq = itertools.count(1)
        self._state = can.BusState.ACTIVE
        self._queue = FrameQueue(rx_queue_size)
        self._wanted = _compile(can_filters)
        self._last_seq: dict[int, int] = {}
        self._counting = threading.Lock()
        self.malformed = 0
        self.lost = 0
        where = endpoint or default_endpoint(self._bench)
        self._own_session = _join(self._bench, where) if session is None else None
        self.channel_info = f"zenoh: channel {self._channel} of bench {self._bench}" + (f" at {where}" if session is None else "")
        self._attach(self._own_session if session is None else session)
        super().__init__(self._channel, can_filters=can_filters)

    def _attach(self, session: Any) -> None:
        head = f"{ROOT}/{self._bench}/{CAN.name}/{self._channel}/"
        self._key_head = head
        key_of = bus_key if self._through_bus else can_key
        self._publisher = FramePublisher(session, self._bench, self._channel, self._congestion, key_of)
        self._name_key = name_key(self._bench, self._channel, self._node)
        try:
            handler = zenoh.handlers.Callback(self._receive, indirect=False)
            self._subscriber = session.declare_subscriber(head + "*", handler)
            self._answers = answer_to(session, self._name_key)
            # An answer comes after its sender knows of this subscription: from now on no frame passes it by.
            _buses_there(session, self._bench, self._channel)
        except zenoh.ZError as error:
            self._close_own_session()
            raise can.CanInitializationError(f"the Zenoh session cannot be used: {_first_line(error)}") from None

    # Runs in Zenoh's receiving thread (or in the sender's, within one session): short, and never raises.
    def _receive(self, sample: zenoh.Sample) -> None:
        payload = sample.payload
        frame = unpack_frame(payload.to_bytes()) if len(payload) == FRAME_SIZE else None
        # Access rules go by keys: a frame may not stand under another one's id.
        if frame is None or str(sample.key_expr) != f"{self._key_head}{frame.arbitration_id:x}":
            with self._counting:
                self.malformed += 1
            return
        if self._through_bus and frame.flags & FLAG_ERROR:
            if frame.node != controller_of(self._node):  # what another node's controller says to its own driver
                return
            self._state = state_after(self._state, frame)
        elif self._through_bus and self._state == can.BusState.ERROR:  # a node that is off the bus hears nothing
            return
        elif frame.node != self._node:
            self._count_lost(frame)
            self._state = state_after(self._state, frame)
        elif not self._receive_own:
            return
        if self._wanted(frame):
            self._queue.put(frame)

    def _count_lost(self, frame: CanFrame) -> None:
        with self._counting:
            last = self._last_seq.get(frame.node)
            if last is None and len(self._last_seq) >= _MAX_SENDERS:
                self._last_seq.clear()
            if last is not None and frame.seq > last + 1:
                self.lost += frame.seq - last - 1
            self._last_seq[frame.node] = max(frame.seq, last or 0)

    @property
    def dropped(self) -> int:
        """Frames thrown away because nobody received them and the queue was full."""
        return self._queue.dropped

    def recv_frame(self, timeout: float | None = None) -> CanFrame | None:
        """As `recv`, but the frame itself, with its stamp in integer nanoseconds. Raises CanOperationError once shut down."""
        return self._queue.take(timeout)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        frame = self._queue.take(timeout)
        if frame is None:
            return None, True
        return to_message(frame, self._channel, is_rx=frame.node != self._node), True

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a message, stamped now. Raises ValueError when it is no classic CAN frame, CanOperationError when shut down."""
        self._put(from_message(msg, next(self._seq), self._clock.now_ns(), self._node))

    def send_frame(self, arbitration_id: int, data: bytes, stamp_ns: int, flags: int = 0) -> CanFrame:
        """Send a data frame (or by `flags` an error frame) stamped `stamp_ns` of the rig clock. Raises as `send` does."""
        frame = make_frame(next(self._seq), stamp_ns, self._node, arbitration_id, data, flags)
        self._put(frame)
        return frame

    def _put(self, frame: CanFrame) -> None:
        if self._is_shutdown:
            raise can.CanOperationError("the bus is shut down")
        if self._through_bus and self._state == can.BusState.ERROR:
            raise can.CanOperationError("the node is off the bus", errno.ENETDOWN)
        try:
            self._publisher.put(frame)
        except zenoh.ZError as error:
            raise can.CanOperationError(f"the Zenoh session is closed: {_first_line(error)}") from None

    def _apply_filters(self, filters: CanFilters | None) -> None:
        self._wanted = _compile(filters)
        self._queue.keep_only(self._wanted)

    def fileno(self) -> int:
        """A descriptor that is readable while frames wait. Raises CanOperationError once shut down."""
        return self._queue.fileno()

    def flush_tx_buffer(self) -> None:
        """Nothing waits to be sent here: `send` hands each frame over at once."""

    @property
    def state(self) -> can.BusState:
        """ACTIVE, PASSIVE, or ERROR for bus-off: what the error frames on the bus said last."""
        return self._state

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        self._state = new_state

    def shutdown(self) -> None:
        """Leave the bus: a blocked `recv` ends with CanOperationError. May be called again."""
        if self._is_shutdown:
            return
        super().shutdown()
        self._queue.close()
        self._publisher.close()
        for declared in (self._subscriber, self._answers):
            with contextlib.suppress(zenoh.ZError, RuntimeError):  # two threads that shut down at once
                declared.undeclare()
        self._close_own_session()

    def _close_own_session(self) -> None:
        if self._own_session is not None:
            with contextlib.suppress(zenoh.ZError):
                self._own_session.close()

    @staticmethod
    def _detect_available_configs() -> list[AutoDetectedConfig]:
        """The channels in use on the default bench, or `can0` when there is none."""
        channels = _channels_in_use(DEFAULT_BENCH, default_endpoint(DEFAULT_BENCH)) or {"can0"}
        return [{"interface": "zenoh", "channel": name} for name in sorted(channels)]


def name_key(bench: str, channel: str, node: int) -> str:
    """The key on which a bus object answers that it is there; 0 is the number of who holds an emulated bus."""
    return f"{ROOT}/{bench}/buses/{channel}/{node:x}"


def answer_to(session: zenoh.Session, own_key: str) -> Any:
    """Answer whoever asks for the buses that are there: it then knows of the subscriptions declared before."""

    def answer(query: zenoh.Query) -> None:
        with query, contextlib.suppress(zenoh.ZError):
            query.reply(own_key, b"")

    return session.declare_queryable(own_key, zenoh.handlers.Callback(answer, indirect=False))


def random_node() -> int:
    """A sender's number: not 0, and its own among all senders."""
    return secrets.randbits(63) + 1


def _chunk(what: str, name: Any) -> str:
    text = str(name)
    if not _CHUNK.fullmatch(text):
        raise ValueError(f"{what} {text!r}: a name without spaces and without any of / * $ ? #, not beginning with @")
    return text


def _compile(filters: Iterable[Any] | None) -> Callable[[CanFrame], bool]:
    """python-can's filters as a test of one frame; error frames pass, as on SocketCAN."""
    rules = [(f["can_id"] & f["can_mask"], f["can_mask"], f.get("extended")) for f in filters or ()]
    if not rules:
        return lambda frame: True

    def wanted(frame: CanFrame) -> bool:
        if frame.flags & FLAG_ERROR:
            return True
        extended = bool(frame.flags & FLAG_EXTENDED)
        return any(frame.arbitration_id & mask == bits and kind in (None, extended) for bits, mask, kind in rules)

    return wanted


def _join(bench: str, endpoint: str) -> zenoh.Session:
    """A session at the meeting point, once it has found the others there. Raises CanInitializationError."""
    try:
        session = open_meeting(bench, endpoint)
    except SoftloopError as error:
        raise can.CanInitializationError(str(error)) from None
    _settle(session)
    return session


def _settle(session: zenoh.Session) -> None:
    """Wait until no more peers turn up, so that what is sent next reaches all of them. At once when alone."""
    start = changed = time.monotonic()
    known = _neighbours(session)
    while known and time.monotonic() - changed < _SETTLE_S and time.monotonic() - start < _SETTLE_AT_MOST_S:
        time.sleep(0.002)
        found = _neighbours(session)
        if found != known:
            known, changed = found, time.monotonic()


def _neighbours(session: zenoh.Session) -> set[str]:
    return {str(zid) for zid in (*session.info.peers_zid(), *session.info.routers_zid())}


def _buses_there(session: zenoh.Session, bench: str, channel: str = "*") -> set[str]:
    """The channels of a bench on which there are buses now; waits until all have answered, or half a second."""
    replies = session.get(
        f"{ROOT}/{bench}/buses/{channel}/*",
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=_ANSWER_AT_MOST_S,
    )
    return {str(reply.ok.key_expr).split("/")[3] for reply in replies if reply.ok}


def _channels_in_use(bench: str, endpoint: str) -> set[str]:
    if endpoint.startswith(UNIX) and not Path(endpoint[len(UNIX) :]).exists():
        return set()
    session = _join(bench, endpoint)
    try:
        return _buses_there(session, bench)
    finally:
        session.close()


def _first_line(error: Exception) -> str:
    return str(error).split(" at ", maxsplit=1)[0].splitlines()[0][:200]
