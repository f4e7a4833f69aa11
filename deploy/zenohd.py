"""The real Zenoh router, `zenohd`, as the meeting point of a bench, where it is installed."""

from __future__ import annotations

import errno
import json
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from softloop.wire.config import QUIC, ZenohConfig
from softloop.wire.errors import Unavailable
from softloop.wire.identity import Identity
from softloop.wire.zenoh_settings import UNIX, settings_of

POLL_S = 0.05
LISTEN_S = 10.0
END_S = 5.0


def find_zenohd(wanted: str) -> str | None:
    """The program that is to be the router: None for softloop itself.

    `wanted`: auto (zenohd where it is installed), zenohd, softloop. Raises Unavailable for a zenohd that is not there.
    """
    found = None if wanted == "softloop" else shutil.which("zenohd")
    if wanted == "zenohd" and found is None:
        raise Unavailable("there is no program zenohd in PATH; `softloop router --with softloop` needs none")
    return found


@contextmanager
def run_zenohd(
    program: str, config: ZenohConfig, where: str, identity: Identity | None = None
) -> Iterator[subprocess.Popen[bytes]]:
    """Run zenohd with the settings of our own router and nothing else. Raises Unavailable when it does not come up."""
    if listens(where):
        raise Unavailable(f"Zenoh endpoint {where}: the address is in use; is this bench running already?")
    with tempfile.NamedTemporaryFile("w", prefix="softloop-zenohd-", suffix=".json5") as file:
        json.dump(nested(settings_of("router", [where], [], config.lease_ms, identity=identity)), file)
        file.flush()
        with subprocess.Popen([program, "--config", file.name], stdin=subprocess.DEVNULL, start_new_session=True) as process:
            try:
                _await_listening(process, where)
                yield process
            finally:
                _end(process)


def nested(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings by path as the tree that a file holds: {"a/b": 1} -> {"a": {"b": 1}}."""
    tree: dict[str, Any] = {}
    for path, value in settings.items():
        *outer, last = path.split("/")
        table = tree
        for part in outer:
            table = table.setdefault(part, {})
        table[last] = value
    return tree


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(END_S)
    except subprocess.TimeoutExpired:
        process.kill()


def _await_listening(process: subprocess.Popen[bytes], where: str) -> None:
    deadline = time.monotonic() + LISTEN_S
    while not listens(where):
        if process.poll() is not None or time.monotonic() >= deadline:
            raise Unavailable(f"zenohd does not listen at {where}; what it says stands above")
        time.sleep(POLL_S)


def listens(where: str) -> bool:
    """Somebody takes connections at an endpoint."""
    if where.startswith(UNIX):
        with socket.socket(socket.AF_UNIX) as probe:
            return probe.connect_ex(where[len(UNIX) :]) == 0
    host, port = where.split("/", 1)[1].rsplit(":", 1)
    if where.startswith(QUIC):
        return _is_taken(host.strip("[]"), int(port))
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=1.0):
            return True
    except OSError:
        return False


def _is_taken(host: str, port: int) -> bool:
    """A UDP port of this machine is somebody's; one of another machine cannot be asked."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((host, port))
        except OSError as error:
            return error.errno == errno.EADDRINUSE
    return False
