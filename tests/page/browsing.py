"""Looking at a page of ours with a browser, strictly: an error in it or a request elsewhere fails the test."""

import time
from contextlib import contextmanager
from urllib.parse import urlsplit

DESKTOP = {"width": 1360, "height": 1180}
PHONE = {"width": 360, "height": 740}
LIVE = "document.body.dataset.connection === 'live' && softloop.store.count > 20"
PATIENCE_MS = 30_000
# What the browser itself says when a server goes away.
LOST = ("ERR_CONNECTION_REFUSED", "WebSocket connection", "ERR_CONNECTION_RESET", "ERR_EMPTY_RESPONSE", "503")


def wait_for(view, expression):
    """Until a JavaScript expression is true. The page's policy forbids what the library would do for this."""
    end = time.monotonic() + PATIENCE_MS / 1000
    while not view.evaluate(expression):
        assert time.monotonic() < end, f"never true: {expression}"
        view.wait_for_timeout(50)


@contextmanager
def viewing(chromium, address, size=DESKTOP, *, wait=LIVE, allow=(), **options):
    """A page of the browser at `address`; `allow`: parts of console errors that are expected."""
    context = chromium.new_context(viewport=size, **options)
    view = context.new_page()
    view.set_default_timeout(PATIENCE_MS)
    errors, hosts = [], set()
    view.on("pageerror", lambda error: errors.append(str(error)))
    view.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
    view.on("request", lambda asked: hosts.add(urlsplit(asked.url).hostname))
    view.on("websocket", lambda socket: hosts.add(urlsplit(socket.url).hostname))
    try:
        view.goto(address)
        if wait:
            wait_for(view, wait)
        yield view
        assert [e for e in errors if not any(part in e for part in allow)] == []
        assert hosts <= {"127.0.0.1", None, ""}
    finally:
        context.close()
