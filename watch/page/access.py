"""Who may see the page and press its buttons.

On loopback anybody on this machine, but no other page in the browser: requests must name this page as their origin, and the
server by a name of this machine, so that a stranger's page can neither arm the rig nor read it. Where a token is set it has to
be brought once, as `?token=`; from then on a cookie brings it.
"""

from __future__ import annotations

import hmac
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

from softloop.wire.errors import BadFile

COOKIE = "softloop_token"
TOKEN_LEAST = 16
_LOCAL_NAMES = {"127.0.0.1", "localhost", "::1"}
Message = MutableMapping[str, Any]
Sender = Callable[[Message], Awaitable[None]]


def read_token(path: Path) -> str:
    """The token in a file. Raises BadFile when there is none, or one that is too short."""
    try:
        token = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise BadFile(f"{path}: the token cannot be read: {error}") from None
    if len(token) < TOKEN_LEAST:
        raise BadFile(f"{path}: a token has at least {TOKEN_LEAST} characters")
    return token


@dataclass(frozen=True)
class Access:
    """The rule: which ports are this page's own, the token (empty: none), and whether it is served on loopback alone."""

    ports: frozenset[int]
    token: str = ""
    loopback: bool = True

    def refusal(self, headers: dict[str, str], query: str) -> str:
        """Why a request is refused; empty when it is not."""
        host = urlsplit(f"//{headers.get('host', '')}")
        if self.loopback and host.hostname not in _LOCAL_NAMES:
            return "this page answers to the names of this machine only"
        if "origin" in headers:
            origin = urlsplit(headers["origin"])
            if origin.hostname != host.hostname or _port(origin.port, origin.scheme) not in self.ports:
                return "another page may not use this one"
        if self.token and not self.brings_token(headers, query):
            return "a token is needed: open this page once as /?token=..."
        return ""

    def brings_token(self, headers: dict[str, str], query: str) -> bool:
        given = [*parse_qs(query).get("token", []), _cookie(headers)]
        return any(hmac.compare_digest(one.encode(), self.token.encode()) for one in given)


def _port(port: int | None, scheme: str) -> int:
    return port or (443 if scheme == "https" else 80)


def _cookie(headers: dict[str, str]) -> str:
    try:
        found = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
    except CookieError:
        return ""
    return found.value if found else ""


class Guard:
    """Asks `Access` before every request and socket of an application."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        query = scope["query_string"].decode("latin-1")
        refused = self._access.refusal(headers, query)
        if refused and scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": refused})
        elif refused:
            await PlainTextResponse(refused + "\n", 403)(scope, receive, send)
        elif self._access.token and scope["path"] == "/" and "token=" in query:
            await self._welcome()(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    def _welcome(self) -> Response:
        """The token goes into a cookie, and out of the address."""
        response = RedirectResponse("/", 303)
        response.set_cookie(COOKIE, self._access.token, httponly=True, secure=True, samesite="strict")
        return response
