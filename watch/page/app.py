"""The page's application: files, buttons, and one WebSocket for each viewer.

A viewer has no queue. It has a place in the history that all share, and reads on from there as fast as its connection takes it;
what waits for a stalled one is a single message. One that fell behind by more than `LAG_ROWS` goes on at the newest rows.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from softloop.watch.page.access import Access, Guard
from softloop.watch.page.feed import Feed
from softloop.watch.page.history import COLUMNS
from softloop.watch.page.requests import Requester, StopLine, ask
from softloop.watch.page.state import as_json, late_edges_ms
from softloop.wire.errors import Unavailable

FILES = Path(__file__).resolve().parent / "files"
VIEWERS_MAX = 32
CHUNK_ROWS = 4096
LAG_ROWS = 800  # four seconds
KEPT_ROWS = 100
# Everything comes from this server, whatever a message may hold.
_POLICY = "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; base-uri 'none'"

Action = Callable[[dict[str, Any]], Awaitable[dict[str, Any]]]


@dataclass
class Site:
    """What the application serves.

    Attributes:
        feed: what viewers read.
        stop_line: the emergency stop.
        hello: what a viewer is told first, JSON-able: the bench, its parameters' names and bounds, laws to choose from.
        actions: name -> what a POST to /action/NAME does with its JSON object. What a bench offers beyond its gate (starting
            an experiment; injecting a fault) stands here; the page shows the section of an action that `hello` names.
        requester: asks the gate, once the bench was reached.
        port, stop_port: where this is served, known when the sockets are bound.
    """

    feed: Feed
    stop_line: StopLine
    hello: dict[str, Any] = field(default_factory=dict)
    actions: Mapping[str, Action] = field(default_factory=dict)
    requester: Requester | None = None
    port: int = 0
    stop_port: int = 0
    viewers: int = 0


def make_app(site: Site, access: Access) -> Starlette:
    """The whole page, its pump included."""

    @contextlib.asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        pump = asyncio.create_task(site.feed.pump())
        yield
        pump.cancel()

    routes = [
        Route("/", partial(_page, site)),
        Route("/stop", partial(_stop, site), methods=["POST"]),
        Route("/request/{action}", partial(_request, site), methods=["POST"]),
        Route("/action/{name}", partial(_action, site), methods=["POST"]),
        WebSocketRoute("/live", partial(_live, site)),
        Mount("/files", StaticFiles(directory=FILES)),
    ]
    return Starlette(routes=routes, middleware=[Middleware(Guard, access=access)], lifespan=lifespan)


def make_stop_app(site: Site, access: Access) -> Starlette:
    """The emergency stop alone, for a thread and a port of its own."""
    routes = [Route("/stop", partial(_stop, site), methods=["POST"])]
    return Starlette(routes=routes, middleware=[Middleware(Guard, access=access)])


async def _page(site: Site, request: Request) -> Response:
    own = f"{request.url.scheme}://{request.url.hostname}:{site.stop_port}"
    policy = f"{_POLICY}; connect-src 'self' {own}; form-action 'self'; frame-ancestors 'none'"
    return FileResponse(FILES / "index.html", headers={"Content-Security-Policy": policy, "Cache-Control": "no-store"})


async def _stop(site: Site, request: Request) -> Response:
    sent = site.stop_line.press()
    if "text/html" in request.headers.get("accept", ""):  # the button without its script
        return RedirectResponse("/", 303)
    return JSONResponse({"sent": sent}, 200 if sent else 503)


async def _request(site: Site, request: Request) -> Response:
    action = request.path_params["action"]
    if action not in ("arm", "disarm"):
        return JSONResponse({"error": f"no request '{action}'"}, 404)
    if site.requester is None:
        return JSONResponse({"obeyed": False, "error": "no gate was heard yet"}, 503)
    try:
        obeyed = await ask(site.requester.send, site.feed.gate, action)
    except Unavailable as error:
        return JSONResponse({"obeyed": False, "error": str(error)}, 403)
    return JSONResponse({"obeyed": obeyed})


async def _action(site: Site, request: Request) -> Response:
    action = site.actions.get(request.path_params["name"])
    if action is None:
        return JSONResponse({"error": "there is no such action here"}, 404)
    try:
        given = await request.json()
    except ValueError:
        return JSONResponse({"error": "not JSON"}, 400)
    if not isinstance(given, dict):
        return JSONResponse({"error": "not a JSON object"}, 400)
    answer = await action(given)
    return JSONResponse(answer, 400 if "error" in answer else 200)


async def _live(site: Site, socket: WebSocket) -> None:
    if site.viewers >= VIEWERS_MAX:
        await socket.close(1013, f"{VIEWERS_MAX} viewers are the most")
        return
    await socket.accept()
    _count(site, 1)
    viewer = asyncio.create_task(_send(site, socket))
    try:
        await _listen(site, socket)
    finally:
        _count(site, -1)
        viewer.cancel()
        with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
            await viewer


def _count(site: Site, change: int) -> None:
    site.viewers += change
    site.feed.more["viewers"] = site.viewers


async def _listen(site: Site, socket: WebSocket) -> None:
    """The only word a viewer can say here is `stop`, in case its requests do not get through."""
    with contextlib.suppress(WebSocketDisconnect, KeyError):  # KeyError: bytes where text is expected
        while True:
            if await socket.receive_text() == "stop":
                site.stop_line.press()


async def _send(site: Site, socket: WebSocket) -> None:
    feed, history = site.feed, site.feed.history
    hello = {"kind": "hello", "columns": COLUMNS, "late_edges_ms": late_edges_ms(), "stop_port": site.stop_port}
    await socket.send_text(as_json(hello | site.hello))
    said = told = -1
    epoch, at, caught_up = -1, 0, False
    while True:
        if epoch != history.epoch:
            epoch, at, caught_up = history.epoch, history.first, False
            await socket.send_text(as_json({"kind": "begin", "start_ns": history.start_ns}))
        if caught_up and history.head - at > LAG_ROWS:
            at = history.head - KEPT_ROWS
        first, last = max(at, history.first), min(at + CHUNK_ROWS, history.head)
        if last > first:
            at = last
            await socket.send_bytes(history.packed(first, last))
        if feed.events_seen != told:
            told = feed.events_seen
            await socket.send_text(feed.events)
        if feed.frame // 3 != said:
            said = feed.frame // 3
            await socket.send_text(feed.state)
        if at >= history.head:
            caught_up = True
            await feed.wait()
