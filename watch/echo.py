"""`softloop echo`: the messages of one channel as text or JSON lines."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from softloop.wire.channels import CAN, CHANNELS, ROOT, Channel
from softloop.wire.errors import BadConfig
from softloop.wire.messages import message


@dataclass(frozen=True)
class Choice:
    """What to echo: a channel, the Zenoh key expression, and the fields (all when empty)."""

    channel: Channel
    key_expr: str
    fields: tuple[str, ...] = ()


def choose(bench: str, text: str) -> Choice:
    """What `cycle`, `cycle.angle_deg`, `cycle.angle_deg,error_deg`, `can`, `can/can0` or `can/can0/80` means.

    Raises BadConfig when there is no such channel or field.
    """
    place, _, fields = text.partition(".")
    name, *rest = place.split("/")
    channel = next((c for c in CHANNELS if c.name == name), None)
    if channel is None or (rest and channel is not CAN) or len(rest) > 2:
        raise BadConfig(f"no channel '{place}'; there are: {', '.join(c.name for c in CHANNELS)}; CAN also as can/BUS/ID")
    asked = tuple(fields.split(",")) if fields else ()
    known = [f.name for f in message(channel.message).fields]
    for one in asked:
        if one not in known:
            raise BadConfig(f"channel '{name}' has no field '{one}'; it has: {', '.join(known)}")
    key_expr = "/".join([ROOT, bench, name, *rest]) + ("/**" if channel is CAN and len(rest) < 2 else "")
    return Choice(channel, key_expr, asked)


def as_text(unpacked: Any, fields: Sequence[str]) -> str:
    """`name=value` pairs in one line; floats with six significant figures, arrays in brackets."""
    return " ".join(f"{name}={_shown(value)}" for name, value in _picked(unpacked, fields))


def as_json(unpacked: Any, fields: Sequence[str]) -> str:
    """One JSON object; what is not finite is null."""
    return json.dumps({name: _plain(value) for name, value in _picked(unpacked, fields)}, allow_nan=False)


def writer(choice: Choice, *, json_lines: bool) -> Callable[[str, bytes], str]:
    """A function from key and payload to a line; it raises BadPayload on bytes that are not the channel's."""
    kind = message(choice.channel.message)
    shape = as_json if json_lines else as_text

    def line(full_key: str, payload: bytes) -> str:
        text = shape(kind.unpack(payload), choice.fields)
        return text if json_lines or choice.channel is not CAN else f"{full_key.split('/', 3)[3]} {text}"

    return line


def _picked(unpacked: Any, fields: Sequence[str]) -> list[tuple[str, Any]]:
    return [(name, getattr(unpacked, name)) for name in fields or unpacked._fields]


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(_shown(v) for v in value) + "]"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
