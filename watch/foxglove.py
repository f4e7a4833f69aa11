"""The channels of a running bench for Foxglove and Lichtblick: a WebSocket server on loopback, fed from the bench.

Messages go out as they are, CDR with their `.msg` text as schema, under the topics of the log, so that one layout fits both.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from softloop.watch.config import FoxgloveConfig
from softloop.wire.channels import CHANNELS, Channel, channel_of_key, key
from softloop.wire.errors import Unavailable
from softloop.wire.mcap_layout import MESSAGE_ENCODING, SCHEMA_ENCODING, Origin, topic_of_key
from softloop.wire.messages import BadPayload, message
from softloop.wire.session import Wire
from softloop.wire.shell import Stop

HOST = "127.0.0.1"
CAPACITY = 20_000
POLL_S = 0.01
KEYS_MAX = 1000  # CAN identifiers make keys


class Thinner:
    """Lets so many messages a second of each key through, evenly spaced by their own stamps."""

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = round(1e9 / rate_hz)
        self._due_ns: dict[str, int] = {}

    def passes(self, full_key: str, channel: Channel, stamp_ns: int) -> bool:
        """Whether this message goes out. A channel that is slower by the table, or speaks when something happens, always does."""
        if channel.rate_hz * self._period_ns <= 1e9:
            return True
        due_ns = self._due_ns.get(full_key, stamp_ns)
        if due_ns - 2 * self._period_ns < stamp_ns < due_ns:
            return False
        behind = not due_ns <= stamp_ns < due_ns + self._period_ns
        self._due_ns[full_key] = (stamp_ns if behind else due_ns) + self._period_ns
        return True


class Bridge:
    """A server and its topics. Give `put` every message."""

    def __init__(self, config: FoxgloveConfig, origin: Origin) -> None:
        """Raises Unavailable when the extra is not installed, or the port is in use."""
        self._sdk = _sdk()
        self._origin = origin
        self._thinner = Thinner(config.rate_hz)
        self._context = self._sdk.Context()
        self._topics: dict[str, Any] = {}
        try:
            self._server = self._sdk.start_server(
                name=f"softloop {origin.bench}", host=HOST, port=config.port, context=self._context, supported_encodings=[]
            )
        except (RuntimeError, OSError, ValueError) as error:
            raise Unavailable(
                f"Foxglove cannot be served on port {config.port}: {_one_line(error)}; see [foxglove] port"
            ) from None
        for channel in CHANNELS:
            if channel.logged and channel.name != "can":
                self._topic(key(origin.bench, channel), channel)

    @property
    def address(self) -> str:
        return f"ws://{HOST}:{self._server.port}"

    def put(self, full_key: str, payload: bytes) -> None:
        """Serve one message; what is no message of the table is left out."""
        channel = channel_of_key(self._origin.bench, full_key)
        if channel is None or not channel.logged:
            return
        try:
            message(channel.message).check(payload)
        except BadPayload:
            return
        stamp_ns = int.from_bytes(payload[12:20], "little", signed=True)  # header, seq, stamp_ns
        if len(self._topics) < KEYS_MAX and self._thinner.passes(full_key, channel, stamp_ns):
            self._topic(full_key, channel).log(payload, log_time=max(0, self._origin.log_time_ns(stamp_ns)))

    def _topic(self, full_key: str, channel: Channel) -> Any:
        found = self._topics.get(full_key)
        if found is None:
            kind = message(channel.message)
            schema = self._sdk.Schema(name=kind.ros_name, encoding=SCHEMA_ENCODING, data=kind.text.encode())
            topic = topic_of_key(full_key)
            found = self._sdk.Channel(topic, schema=schema, message_encoding=MESSAGE_ENCODING, context=self._context)
            self._topics[full_key] = found
        return found

    def close(self) -> None:
        self._server.stop()


def _sdk() -> Any:
    try:
        import foxglove  # noqa: PLC0415 - an optional extra
    except ImportError:
        raise Unavailable("foxglove-sdk is not installed; it is the extra 'foxglove' of softloop") from None
    return foxglove


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def serve(bridge: Bridge, wire: Wire, stop: Stop, on_ready: Callable[[str], None]) -> None:
    """Hand on what comes by, until `stop`."""
    inbox = wire.everything(CAPACITY)
    on_ready(bridge.address)
    while not stop:
        for item in inbox.take_all()[0]:
            bridge.put(*item)
        time.sleep(POLL_S)
    bridge.close()
