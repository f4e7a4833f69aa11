"""Joining a running bench to look at it: by way of its meeting point alone, so that no process of the rig gets a link more."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from softloop.wire.config import ZenohConfig
from softloop.wire.errors import Unavailable
from softloop.wire.session import Wire, open_wire
from softloop.wire.zenoh_settings import UNIX

POLL_S = 0.1


def is_there(endpoint: str) -> bool:
    """Whether somebody listens at a meeting point now."""
    unix = endpoint.startswith(UNIX)
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        with socket.socket(socket.AF_UNIX if unix else _family(host), socket.SOCK_STREAM) as probe:
            probe.settimeout(1.0)
            probe.connect(endpoint[len(UNIX) :] if unix else (host.strip("[]"), int(port)))
    except OSError:
        return False
    return True


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if host.startswith("[") else socket.AF_INET


@contextmanager
def guest_wire(
    config: ZenohConfig, bench: str, name: str, patience_s: float = 0.0, give_up: Callable[[], bool] = lambda: False
) -> Iterator[Wire]:
    """A wire that joins a bench as a client of its meeting point; when that comes back, the wire is back by itself.

    Args:
        config: the bench's `[zenoh]`.
        bench: its name.
        name: what this guest is called.
        patience_s: how long to wait for a bench that is not running.
        give_up: asked while waiting; true ends it.

    Raises:
        Unavailable: nobody is at the meeting point.
    """
    where = config.meeting_point(bench)
    deadline = time.monotonic() + patience_s
    while not is_there(where):
        if give_up() or time.monotonic() >= deadline:
            raise Unavailable(f"nobody of bench '{bench}' is at {where}; is it running?")
        time.sleep(POLL_S)
    with open_wire(config.model_copy(update={"mode": "client"}), bench, name) as wire:
        yield wire
