"""Serving the page: two listeners, each with a thread and an event loop of its own.

The second serves the emergency stop and nothing else, and its Zenoh session carries nothing else: whatever keeps the first one
busy, a press is taken and sent.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import uvicorn

from softloop.watch.config import PageConfig
from softloop.watch.guest import guest_wire
from softloop.watch.page.access import Access, read_token
from softloop.watch.page.app import Site, make_app, make_stop_app
from softloop.watch.page.requests import Requester
from softloop.wire.config import ZenohConfig
from softloop.wire.errors import Unavailable
from softloop.wire.session import Wire
from softloop.wire.shell import Stop, say

NAME = "page"
START_S = 10.0
POLL_S = 0.1


def serve(site: Site, config: PageConfig, zenoh: ZenohConfig, bench: str, stop: Stop, on_ready: Callable[[str], None]) -> None:
    """Serve a bench's page until `stop`; the bench may come and go. `on_ready` is told the page's address.

    Raises:
        BadFile: the token, the certificate or its key cannot be read.
        Unavailable: the port is in use.
    """
    token = read_token(Path(config.token_file)) if config.token_file else ""
    main, own = _bind(config)
    site.port, site.stop_port = main.getsockname()[1], own.getsockname()[1]
    access = Access(frozenset({site.port, site.stop_port}), token, config.loopback)
    servers = [(_server(make_app(site, access), config), main), (_server(make_stop_app(site, access), config), own)]
    joiner = threading.Thread(target=_join, args=(site, zenoh, bench, stop), name="join", daemon=True)
    with _running(servers):
        joiner.start()
        on_ready(f"{'https' if config.certificate else 'http'}://{_shown(config.host)}:{site.port}/")
        while not stop.wait(POLL_S):
            if any(server.should_exit for server, _ in servers):
                stop.set("the server ended")
    site.stop_line.close()
    joiner.join(START_S)


def _shown(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _bind(config: PageConfig) -> tuple[socket.socket, socket.socket]:
    """The page's socket, and that of the emergency stop on the next port. Raises Unavailable."""
    main = _listener(config.host, config.port)
    try:
        return main, _listener(config.host, config.port + 1 if config.port else 0)
    except Unavailable:
        main.close()
        raise


def _listener(host: str, port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(64)
    except OSError as error:
        listener.close()
        raise Unavailable(f"the page cannot listen on {host} port {port}: {error.strerror or error}; see [page] port") from None
    return listener


def _server(app: Any, config: PageConfig) -> uvicorn.Server:
    """One uvicorn. Messages are small and many, so they are not compressed; a viewer that does not answer for 20 s is let go."""
    settings = uvicorn.Config(
        app,
        ws="websockets-sansio",
        ws_per_message_deflate=False,
        ws_max_size=4096,
        ws_ping_interval=10.0,
        ws_ping_timeout=20.0,
        ssl_certfile=config.certificate or None,
        ssl_keyfile=config.key or None,
        log_level="error",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=1,
    )
    try:
        settings.load()
    except OSError as error:  # also what ssl raises
        raise Unavailable(f"TLS: {config.certificate}, {config.key}: {error.strerror or error}") from None
    return uvicorn.Server(settings)


@contextlib.contextmanager
def _running(servers: list[tuple[uvicorn.Server, socket.socket]]) -> Iterator[None]:
    threads = [threading.Thread(target=s.run, kwargs={"sockets": [at]}, daemon=True) for s, at in servers]
    for thread in threads:
        thread.start()
    deadline = time.monotonic() + START_S
    while not all(server.started for server, _ in servers) and time.monotonic() < deadline:
        time.sleep(0.01)
    try:
        yield
    finally:
        for server, _ in servers:
            server.should_exit = True
        for thread, (_, at) in zip(threads, servers, strict=True):
            thread.join(START_S)
            at.close()


def _join(site: Site, zenoh: ZenohConfig, bench: str, stop: Stop) -> None:
    """Reach the bench, as soon as it is there, by two sessions; Zenoh keeps them up, also over another start of the bench."""

    def use(wire: Wire, stop_wire: Wire) -> None:
        wire.settle(lambda: bool(stop))
        site.stop_line.connect(stop_wire)
        site.requester = Requester(wire, site.feed.gate_stamp_ns)
        site.feed.connect(wire)
        while not stop.wait(POLL_S):
            pass

    while not stop:
        try:
            with _guest(zenoh, bench, NAME, stop) as wire, _guest(zenoh, bench, f"{NAME}-stop", stop) as stop_wire:
                use(wire, stop_wire)
        except Unavailable as error:
            if not stop:
                say(NAME, str(error))


def _guest(zenoh: ZenohConfig, bench: str, name: str, stop: Stop) -> contextlib.AbstractContextManager[Wire]:
    return guest_wire(zenoh, bench, name, float("inf"), lambda: bool(stop))
