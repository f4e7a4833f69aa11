"""Commands that look at a run from outside while it lasts: the page, the Foxglove bridge."""

from __future__ import annotations

import contextlib
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from softloop.deploy.children import PROGRAM, Child
from softloop.deploy.keeper import Kept

END_S = 5.0
FIRST_WORD_S = 20.0
POLL_S = 0.2


def onlookers(bench_file: Path, page: bool, foxglove: bool) -> list[list[str]]:
    """The commands that look at a run from outside."""
    return [[name, str(bench_file)] for name, wanted in (("page", page), ("foxglove", foxglove)) if wanted]


@contextlib.contextmanager
def beside(commands: list[list[str]], run_dir: Path, say: Callable[[str], None]) -> Iterator[list[Kept]]:
    """Run `softloop COMMAND` for each while the block lasts, its words in `COMMAND.log`, the first one said.

    The run does not depend on them: one that cannot start, or ends, is said. Gives them to whoever brings back one that dies.
    """
    started = [_kept(command, run_dir / f"{command[0]}.log") for command in commands]
    try:
        for kept in started:
            threading.Thread(target=_say_first_word, args=(kept.child, say), daemon=True).start()
        yield started
    finally:
        for kept in started:
            kept.child.popen.terminate()
        for kept in started:
            _wait(kept.child)


def _kept(command: list[str], log: Path) -> Kept:
    return Kept(_start(command, log), lambda: _start(command, log))


def _start(command: list[str], log: Path) -> Child:
    with log.open("ab") as output:
        popen = subprocess.Popen(
            [*PROGRAM, *command], stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
        )
    return Child(command[0], popen, log)


def _say_first_word(child: Child, say: Callable[[str], None]) -> None:
    end = time.monotonic() + FIRST_WORD_S
    while time.monotonic() < end:
        word = child.last_line()
        if word:
            say(word)
            return
        time.sleep(POLL_S)


def _wait(child: Child) -> None:
    try:
        child.popen.wait(END_S)
    except subprocess.TimeoutExpired:
        child.popen.kill()
        child.popen.wait()
