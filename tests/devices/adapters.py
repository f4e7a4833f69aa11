"""Adapters running in threads on real Zenoh sessions, for tests."""

import threading
import time
from contextlib import contextmanager

from softloop.wire.channels import EVENT, STATUS
from softloop.wire.messages import message
from softloop.wire.session import open_wire
from softloop.wire.shell import Context

PATIENCE_S = 15.0


class QuietContext(Context):
    """Leaves the test process's garbage collector alone."""

    def enter_loop(self):
        self.wire.declare_alive()


class Running:
    """An adapter's thread: `context` to stop it, `error` what it raised."""

    def __init__(self, run, config, context):
        self.context, self.error = context, None
        self._thread = threading.Thread(target=self._body, args=(run, config), daemon=True)
        self._thread.start()

    def _body(self, run, config):
        try:
            run(config, self.context)
        except Exception as error:  # noqa: BLE001 - it is raised again in the test's own thread
            self.error = error

    def ended(self):
        return not self._thread.is_alive()

    def stop(self):
        self.context.stop.set("test")
        self._thread.join(PATIENCE_S)
        assert self.ended(), "the adapter hangs"


@contextmanager
def bench(meet):
    """(wire of the adapter, wire of the test) on one bench."""
    with open_wire(meet, "test", "adapter") as a, open_wire(meet, "test", "tester") as b:
        yield a, b


@contextmanager
def running(run, config, wire, folder):
    """An adapter, stopped at the end. Raises what it raised."""
    adapter = Running(run, config, QuietContext("adapter", "test", folder, wire))
    try:
        yield adapter
    finally:
        adapter.stop()
    if adapter.error is not None:
        raise adapter.error


def run_to_its_end(run, config, wire, folder):
    """Run an adapter that ends by itself. Raises what it raised."""
    with running(run, config, wire, folder) as adapter:
        until(adapter.ended)


def until(condition, timeout_s=PATIENCE_S):
    """The first true value of `condition`."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.002)
    raise AssertionError("it did not happen in time")


class Listener:
    """All messages of one channel, unpacked, in the order of arrival."""

    def __init__(self, wire, channel):
        self._inbox, self._kind = wire.inbox(channel), message(channel.message)
        self.all = []

    def look(self):
        """All so far, the newest last."""
        self.all += [self._kind.unpack(payload) for _, payload in self._inbox.take_all()]
        return self.all

    def find(self, **fields):
        """The first with these fields."""
        return next((m for m in self.look() if all(getattr(m, k) == v for k, v in fields.items())), None)


def listeners(wire, *channels):
    return [Listener(wire, c) for c in (*channels, EVENT, STATUS)]
