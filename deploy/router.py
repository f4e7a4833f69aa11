"""The meeting point of a bench: held by the launcher for its own run, or by `softloop router` for several."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import zenoh

from softloop.deploy.bench import Bench
from softloop.wire.errors import Unavailable
from softloop.wire.session import UNIX, Wire, open_router, open_session
from softloop.wire.shell import Stop

LAUNCHER = "launcher"
POLL_S = 0.1
JOIN_S = 3.0  # joining takes well under a tenth of a second


@contextmanager
def launcher_wire(bench: Bench) -> Iterator[Wire]:
    """The launcher's end of a bench: it is the meeting point, or joins a shared one.

    Raises:
        Unavailable: the address is in use; or nobody is at the shared meeting point, or the bench runs there already.
    """
    shared = bench.run.shared_router
    session = open_session(bench.zenoh, bench.name, LAUNCHER) if shared else meeting_point(bench)
    with session:
        wire = Wire(session, bench.name, LAUNCHER)
        if shared:
            _be_alone(wire, bench.zenoh.meeting_point(bench.name))
        wire.declare_alive()
        yield wire


def _be_alone(wire: Wire, where: str) -> None:
    """Wait for the router, and see that it knows nobody else of this bench."""
    deadline = time.monotonic() + JOIN_S
    while not wire.session.info.routers_zid():
        if time.monotonic() >= deadline:
            raise Unavailable(f"no router at {where}; start one with `softloop router`, or set [run] shared_router = false")
        time.sleep(POLL_S)
    running = wire.processes_alive()
    if running:
        raise Unavailable(f"bench '{wire.bench}' is running already at {where}: {', '.join(sorted(running))}")


def remove_sockets(bench: Bench, pid: int) -> None:
    """Remove the Zenoh sockets that a process that was killed left beside the meeting point."""
    meet = bench.zenoh.meeting_point(bench.name)
    if meet.startswith(UNIX):
        path = Path(meet[len(UNIX) :])
        for left in path.parent.glob(f"{path.stem}.*.{pid}.sock*"):
            left.unlink(missing_ok=True)


def meeting_point(bench: Bench) -> zenoh.Session:
    """The session of a meeting point. Raises Unavailable when the address is in use.

    In mode client all samples of the 5 ms path pass it: its Zenoh threads take real-time priority where the machine grants it,
    a step below the loop's, so that whoever floods the meeting point does not keep the loop from its processor. What else this
    process does stays as it was.
    """
    own = os.sched_getscheduler(0), os.sched_getparam(0)
    if bench.zenoh.mode == "client" and bench.host.realtime_priority > 1:
        with suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(bench.host.realtime_priority - 1))
    try:
        return open_router(bench.zenoh, bench.name)  # the threads that it starts inherit
    finally:
        os.sched_setscheduler(0, *own)


def run_router(bench: Bench, stop: Stop) -> None:
    """Be the meeting point until asked to stop. Raises Unavailable when the address is in use."""
    with meeting_point(bench):
        print(f"meeting point of bench '{bench.name}': {bench.zenoh.meeting_point(bench.name)}", flush=True)
        while not stop.wait(POLL_S):
            pass
