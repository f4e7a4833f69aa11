"""The launcher's child processes: started with a lifeline, looked after, ended in order."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from softloop.wire.errors import EXIT_LOST

TAIL_BYTES = 4096
POLL_S = 0.01
PROGRAM = (sys.executable, "-m", "softloop.deploy.cli")


@dataclass
class Child:
    """One process that we started. Its output goes to `log`."""

    name: str
    popen: subprocess.Popen[bytes]
    log: Path
    killed: bool = False

    @property
    def pid(self) -> int:
        return self.popen.pid

    def exit_code(self) -> int | None:
        """None while it runs."""
        return self.popen.poll()

    def last_line(self) -> str:
        """The last thing it said, or an empty text."""
        try:
            with self.log.open("rb") as file:
                file.seek(max(0, self.log.stat().st_size - TAIL_BYTES))
                lines = file.read().decode(errors="replace").splitlines()
        except OSError:
            return ""
        return next((line.strip() for line in reversed(lines) if line.strip()), "")

    def epitaph(self) -> str:
        """How it ended and what it said last, in one line."""
        code = self.exit_code()
        how = f"killed by {_signal_name(-code)}" if code is not None and code < 0 else f"ended with code {code}"
        said = self.last_line()
        return f"process '{self.name}' {how}" + (f": {said}" if said else f"; it said nothing ({self.log})")

    def exit_code_for_a_person(self) -> int:
        """Its own exit code when it gave one; a process that was killed, or that just left, counts as lost."""
        code = self.exit_code()
        return code if code is not None and code > 0 else EXIT_LOST


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


class Children:
    """All children of one launcher, tied to its life.

    They hold the read end of a pipe whose write end only the launcher has: when the launcher dies, however it dies, each
    sees the end of the pipe, vents and exits. Each has a session of its own, so that Ctrl-C reaches the launcher alone.
    """

    def __init__(self, program: Sequence[str] = PROGRAM) -> None:
        self._program = program
        self._read_end, self._write_end = os.pipe()
        self.all: dict[str, Child] = {}

    def start(self, name: str, arguments: Sequence[str], log: Path) -> Child:
        """Start `PROGRAM ARGUMENTS --lifeline-fd N`; one of the same name, which has ended, goes out of sight."""
        command = [*self._program, *arguments, "--lifeline-fd", str(self._read_end)]
        with log.open("ab") as output:  # what one said that died before stays
            popen = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                pass_fds=(self._read_end,),
                start_new_session=True,
                env=_environment(),
            )
        self.all[name] = Child(name, popen, log)
        return self.all[name]

    def ended(self, but: Collection[str] = ()) -> Child | None:
        """A child that is no longer running, if there is one, other than those named in `but`."""
        return next((c for c in self.all.values() if c.name not in but and c.exit_code() is not None), None)

    def stop(
        self, order: Iterable[Sequence[str]], timeout_s: float, after_group: Callable[[Sequence[str]], None] = lambda group: None
    ) -> list[Child]:
        """Ask each group in turn to end, and kill what has not after `timeout_s`; returns the killed ones."""
        for group in order:
            self._stop_group([self.all[name] for name in group if name in self.all], timeout_s)
            after_group(group)
        rest = [c for c in self.all.values() if c.exit_code() is None]
        self._stop_group(rest, timeout_s)
        return [c for c in self.all.values() if c.killed]

    def _stop_group(self, group: list[Child], timeout_s: float) -> None:
        for child in group:
            if child.exit_code() is None:
                child.popen.terminate()
        deadline = time.monotonic() + timeout_s
        while any(c.exit_code() is None for c in group) and time.monotonic() < deadline:
            time.sleep(POLL_S)
        for child in group:
            if child.exit_code() is None:
                child.popen.kill()
                child.killed = True
                child.popen.wait()

    def close(self) -> None:
        """Kill whatever is left and let go of the pipe."""
        for child in self.all.values():
            if child.exit_code() is None:
                child.popen.kill()
                child.popen.wait()
        os.close(self._write_end)
        os.close(self._read_end)


def _environment() -> dict[str, str]:
    # No process of a rig uses BLAS on its 5 ms path; its thread pool would only take memory and, at start, both cores.
    return {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
