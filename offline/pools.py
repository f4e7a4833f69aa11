"""Where the runs of a campaign are worked off: in this process, in several of this machine, or on a Dask cluster.

Each generator gives results in the order in which they get done. When it is closed, or Ctrl-C comes, what has not begun is
dropped and its processes end.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import forkserver, get_context, parent_process, resource_tracker
from multiprocessing.connection import wait as wait_for
from typing import Any

from softloop.offline.campaign import Case, Result, run_case, run_cases
from softloop.offline.closed_loop import RigTables
from softloop.wire.errors import BadConfig, Lost, Unavailable
from softloop.wire.mcap_layout import versions

CHUNK = 4  # runs that a worker does in one go: some tenths of a second
CONNECT_S = 10
_POLL_S = 0.5  # how often a wait looks up for Ctrl-C
_AT_ONCE = 3  # chunks per worker that are handed out ahead
_HERE_ONLY = ("kernel", "cpu")  # may differ between machines of a cluster without a word


def chunks(cases: Sequence[Case], size: int = CHUNK) -> list[Sequence[Case]]:
    """`cases` in pieces of at most `size`."""
    return [cases[k : k + size] for k in range(0, len(cases), size)]


def run_here(tables: RigTables, cases: Sequence[Case]) -> Iterator[Result]:
    """One after the other in this process."""
    for case in cases:
        yield run_case(tables, case)


def run_in_processes(tables: RigTables, cases: Sequence[Case], jobs: int) -> Iterator[Result]:
    """In `jobs` processes. They come from a fork server that has loaded the kernels once. Raises Lost when one of them dies."""
    context = get_context("forkserver")
    context.set_forkserver_preload([__name__])
    resource_tracker.ensure_running()  # else that of the fork server does it, and lets interrupts through from then on
    with _interrupts_blocked():  # inherited: Ctrl-C reaches the whole group, and the parent ends its workers
        forkserver.ensure_running()
    pool = ProcessPoolExecutor(jobs, context, initializer=_begin_worker)
    try:
        waiting, under_way = iter(chunks(cases)), set[Future[list[Result]]]()
        while _hand_out(pool, tables, waiting, under_way, _AT_ONCE * jobs):
            done, _ = wait(under_way, _POLL_S, FIRST_COMPLETED)
            under_way -= done
            for future in done:
                yield from future.result()
    except (BrokenProcessPool, EOFError, ConnectionError):  # of a worker, of the fork server
        raise Lost("a worker process ended by itself; what is done is lost with it") from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _hand_out(
    pool: ProcessPoolExecutor, tables: RigTables, waiting: Iterator[Sequence[Case]], under_way: set[Any], enough: int
) -> bool:
    """Keep `enough` chunks under way as long as there are any; False when all is done."""
    while len(under_way) < enough and (chunk := next(waiting, None)) is not None:
        under_way.add(pool.submit(run_cases, tables, chunk))
    return bool(under_way)


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Ctrl-C stays pending for this thread meanwhile; what is started keeps it blocked."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin_worker() -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        wait_for([parent.sentinel])
        os._exit(0)


def run_on_dask(tables: RigTables, cases: Sequence[Case], scheduler: str) -> Iterator[Result]:
    """On the workers of a Dask cluster, each with the same softloop and the files that the bench names.

    Raises:
        BadConfig: the extra `dask` is not installed, or a worker's versions are not those of this process.
        Unavailable: nobody answers at `scheduler`, or it has no worker.
    """
    client, as_completed = connect(scheduler)
    try:
        check_workers(client)
        [shared] = client.scatter([tables], broadcast=True)
        futures = [client.submit(run_cases, shared, chunk, pure=False) for chunk in chunks(cases)]
        for future in as_completed(futures, loop=client.loop):
            yield from future.result()
            future.release()
    finally:
        client.close()


def connect(scheduler: str) -> tuple[Any, Any]:
    """A client of a Dask scheduler, and Dask's `as_completed`. Raises as `run_on_dask` does."""
    try:
        from distributed import Client, as_completed  # noqa: PLC0415 - an extra: only who asks for it needs it
    except ImportError:
        raise BadConfig("--scheduler needs the extra 'dask': pip install 'softloop[dask]'") from None
    try:
        return Client(scheduler, timeout=CONNECT_S, set_as_default=False), as_completed
    except (OSError, ValueError) as error:  # its TimeoutError is an OSError
        raise Unavailable(f"no Dask scheduler answers at {scheduler}: {error}") from None


def check_workers(client: Any) -> None:
    """Raises Unavailable when there is no worker, BadConfig when one would compute with other versions than this process."""
    own = _bearing(versions())
    found = client.run(versions)
    if not found:
        raise Unavailable("the Dask scheduler has no worker")
    for address, theirs in found.items():
        apart = [f"{name} {theirs.get(name)} (here {mine})" for name, mine in own.items() if theirs.get(name) != mine]
        if apart:
            raise BadConfig(f"Dask worker {address} has other versions: {', '.join(apart)}")


def _bearing(found: dict[str, str]) -> dict[str, str]:
    return {name: version for name, version in found.items() if name not in _HERE_ONLY}
