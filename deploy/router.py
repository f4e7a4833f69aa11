"""The meeting point of a bench: held by the launcher for its own run, or by `softloop router` for several."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import zenoh

from softloop.deploy.bench import Bench
from softloop.deploy.hosts import launcher_name, leader, on_host, shares
from softloop.deploy.zenohd import run_zenohd
from softloop.wire.config import ZenohConfig
from softloop.wire.errors import Interrupted, Lost, Unavailable
from softloop.wire.identity import identity_of
from softloop.wire.rights import ROUTER
from softloop.wire.session import Wire, open_router, open_session, open_wire
from softloop.wire.shell import Stop
from softloop.wire.zenoh_settings import UNIX

POLL_S = 0.1
JOIN_S = 3.0  # joining takes well under a tenth of a second
ALONE_S = 0.5  # a router answers within milliseconds, on a busy machine within some tenths of a second


@contextmanager
def launcher_wire(bench: Bench, host: str = "", stop: Stop | None = None, say: Callable[[str], None] = print) -> Iterator[Wire]:
    """The launcher's end of a bench: it is the meeting point, or joins a shared one, or that of the host which leads.

    Raises:
        Unavailable: the address is in use; or nobody is at the shared meeting point, or the bench runs there already.
        Interrupted: asked to stop while waiting for the host which leads.
    """
    leads, name = not host or host == leader(bench), launcher_name(bench, host)
    config = on_host(bench, host).zenoh
    joins = bench.run.shared_router or not leads
    patience_s = bench.run.hosts_wait_s if host else JOIN_S
    identity = identity_of(config, bench.name, name) if joins else None  # the meeting point's own has no bounds
    with ExitStack() as stack:
        if joins:
            session = stack.enter_context(_join(config, bench.name, name, patience_s, stop or Stop(), say))
        else:
            with _ahead(bench):
                session = stack.enter_context(open_router(config, bench.name))
        wire = Wire(session, bench.name, name, identity)
        if joins:
            _be_alone(config, bench.name, name, _own_names(bench, host, name))
        wire.declare_alive()
        yield wire


def _own_names(bench: Bench, host: str, launcher: str) -> set[str] | None:
    """Who must not be there yet; None for nobody at all."""
    return {launcher, *shares(bench)[host]} if host else None


def _join(config: ZenohConfig, bench: str, name: str, patience_s: float, stop: Stop, say: Callable[[str], None]) -> zenoh.Session:
    """A session that has found its router; a client opens only where there is one. Raises Unavailable when none comes."""
    where = config.meeting_point(bench)
    no_router = f"no router at {where}; start one with `softloop router`, or set [run] shared_router = false"
    deadline = time.monotonic() + patience_s
    told = False
    while True:
        session = _try_to_join(config, bench, name, JOIN_S if patience_s > JOIN_S else patience_s, stop)
        if session is not None:
            return session
        if stop:
            raise Interrupted("interrupted while waiting for the meeting point")
        if time.monotonic() >= deadline:
            raise Unavailable(no_router)
        if not told:
            told = True
            say(f"waiting for the meeting point {where}")


def _try_to_join(config: ZenohConfig, bench: str, name: str, patience_s: float, stop: Stop) -> zenoh.Session | None:
    deadline = time.monotonic() + patience_s
    try:
        session = open_session(config, bench, name)
    except Unavailable:
        if config.mode == "client":
            stop.wait(POLL_S)
            return None
        raise
    while not session.info.routers_zid() and not stop and time.monotonic() < deadline:
        time.sleep(POLL_S)
    if session.info.routers_zid():
        return session
    session.close()
    return None


def _be_alone(config: ZenohConfig, bench: str, name: str, own: set[str] | None) -> None:
    """See that nobody else is there for this bench, or nobody of this host. Raises Unavailable when somebody is.

    The router itself is asked, by a client, for a while: what a peer is told in the moment it joins can be lost to it for good.
    """
    deadline = time.monotonic() + ALONE_S
    with open_wire(config.model_copy(update={"mode": "client"}), bench, name) as asks:
        while time.monotonic() < deadline:
            running = asks.processes_alive()
            if own is not None:
                running &= own
            if running:
                where = config.meeting_point(bench)
                raise Unavailable(f"bench '{bench}' is running already at {where}: {', '.join(sorted(running))}")
            time.sleep(POLL_S)


def remove_sockets(bench: Bench, pid: int) -> None:
    """Remove the Zenoh sockets that a process that was killed left beside the meeting point."""
    meet = bench.zenoh.meeting_point(bench.name)
    if meet.startswith(UNIX):
        path = Path(meet[len(UNIX) :])
        for left in path.parent.glob(f"{path.stem}.*.{pid}.sock*"):
            left.unlink(missing_ok=True)


@contextmanager
def _ahead(bench: Bench) -> Iterator[None]:
    """In mode client all of the 5 ms path passes the meeting point: what is started here has real-time priority, where granted.

    A step below the loop's, so that whoever floods the meeting point does not keep the loop from its processor. What else this
    process does stays as it was.
    """
    own = os.sched_getscheduler(0), os.sched_getparam(0)
    if bench.zenoh.mode == "client" and bench.host.realtime_priority > 1:
        with suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(bench.host.realtime_priority - 1))
    try:
        yield
    finally:
        os.sched_setscheduler(0, *own)


def run_router(bench: Bench, stop: Stop, program: str | None = None) -> None:
    """Be the meeting point until asked to stop, or let `program`, a zenohd, be it.

    Raises:
        Unavailable: the address is in use.
        Lost: zenohd ended by itself.
    """
    where = bench.zenoh.meeting_point(bench.name)
    with ExitStack() as stack:
        with _ahead(bench):
            held: Any = stack.enter_context(_zenohd(bench, program) if program else open_router(bench.zenoh, bench.name))
        by = f" ({program})" if program else ""
        print(f"meeting point of bench '{bench.name}': {where}{by}", flush=True)
        while not stop.wait(POLL_S):
            if isinstance(held, subprocess.Popen) and held.poll() is not None:
                raise Lost(f"{program} ended with code {held.returncode}")


def _zenohd(bench: Bench, program: str) -> AbstractContextManager[subprocess.Popen[bytes]]:
    identity = identity_of(bench.zenoh, bench.name, ROUTER)
    return run_zenohd(program, bench.zenoh, bench.zenoh.meeting_point(bench.name), identity)
