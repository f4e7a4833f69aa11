"""Progress of compiling kernels and of long work, on a terminal only, and only when there is something to wait for."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress


@contextmanager
def compile_progress(*, quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """A function `progress(module, done, total)` that shows how far compiling has come."""
    if quiet or not sys.stderr.isatty():
        yield lambda module, done, total: None
        return

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("compiling kernels", total=None)

        def show(module: str, done: int, total: int) -> None:
            bar.update(task, completed=done, total=total, description=f"compiling {module.removeprefix('softloop.')}")

        yield show


@contextmanager
def tick_progress(*, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """A function `progress(done, total)` that shows how many ticks are done."""
    with counted_progress("replaying ticks", quiet=quiet) as progress:
        yield progress


@contextmanager
def counted_progress(what: str, *, quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """A function `progress(done, total)` that shows how much of `what` is done."""
    if quiet or not sys.stderr.isatty():
        yield lambda done, total: None
        return

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
