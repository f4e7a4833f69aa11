"""The shared meeting point as a child of the launcher, where an injection takes it away and gives it back."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from softloop.deploy.bench import Bench
from softloop.deploy.children import Child, Children
from softloop.wire.errors import Unavailable

NAME = "router"
THERE_S = 30.0
POLL_S = 0.02
STOP_S = 5.0


class OwnRouter:
    """`softloop router` of a bench, tied to this process's life. Its words are in `router.log`."""

    def __init__(self, bench_file: Path, run_dir: Path) -> None:
        self._children = Children()
        self._arguments = [NAME, str(bench_file), "--with", "softloop"]
        self._log = run_dir / f"{NAME}.log"
        self._child = self.start()

    def start(self) -> Child:
        """Start it, or start it anew; it is there some tenths of a second later."""
        self._child = self._children.start(NAME, self._arguments, self._log)
        return self._child

    def wait_there(self) -> None:
        """Until it says that it is there. Raises Unavailable with its last words where it ends, or says nothing."""
        end_s = time.monotonic() + THERE_S
        while "meeting point of bench" not in (word := self._child.last_line()):
            if self._child.exit_code() is not None or time.monotonic() >= end_s:
                raise Unavailable(f"the router that is to be lost did not start: {word or 'it said nothing'}")
            time.sleep(POLL_S)

    def kill(self) -> None:
        """Take it away, as by a power cut."""
        self._child.popen.kill()
        self._child.popen.wait()

    def close(self) -> None:
        """End it in order."""
        self._children.stop([(NAME,)], STOP_S)
        self._children.close()


@contextmanager
def own_router(bench: Bench, bench_file: Path, run_dir: Path) -> Iterator[OwnRouter | None]:
    """The router of a run whose injections want it lost, there before anybody joins; None in every other run.

    Raises Unavailable where it cannot be: another one is at its address.
    """
    if not any(injection.family == "router" for injection in bench.faults.injections):
        yield None
        return
    router = OwnRouter(bench_file, run_dir)
    try:
        router.wait_there()
        yield router
    finally:
        router.close()
