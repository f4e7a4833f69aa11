"""The meeting point of a bench: held by the launcher for its own run, or by `softloop router` for several."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from softloop.deploy.bench import Bench
from softloop.wire.errors import Unavailable
from softloop.wire.session import UNIX, Wire, open_router, open_session, own_endpoint

LAUNCHER = "launcher"


@contextmanager
def launcher_wire(bench: Bench) -> Iterator[Wire]:
    """The launcher's end of a bench: it is the meeting point, or joins a shared one.

    Raises:
        Unavailable: the address is in use, or the bench runs already at the shared meeting point.
    """
    shared = bench.run.shared_router
    session = open_session(bench.zenoh, bench.name, LAUNCHER) if shared else open_router(bench.zenoh, bench.name)
    with session:
        wire = Wire(session, bench.name, LAUNCHER)
        running = wire.processes_alive() if shared else set()
        if running:
            where = bench.zenoh.meeting_point(bench.name)
            raise Unavailable(f"bench '{bench.name}' is running already at {where}: {', '.join(sorted(running))}")
        wire.declare_alive()
        yield wire


def remove_sockets(bench: Bench, process: str, pid: int) -> None:
    """Remove what a process that was killed left of its own Zenoh socket."""
    own = own_endpoint(bench.zenoh.meeting_point(bench.name), process, pid)
    if own.startswith(UNIX):
        for end in ("", ".lock"):
            Path(own[len(UNIX) :] + end).unlink(missing_ok=True)
