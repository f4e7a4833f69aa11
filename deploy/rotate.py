"""The disk budget of `[recorder]`: a bench's oldest runs go, or its next run is refused. No run is touched that is in use.

A run is in use while its launcher holds its `bench.toml`, or a recorder one of its logs (shared locks, which the kernel lets go
when their holder dies, however it dies). A run that holds a file `keep` stays until a person removes it; it counts all the same.
"""

from __future__ import annotations

import fcntl
import shutil
import threading
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from softloop.deploy.bench import Bench, find_bench, load_bench
from softloop.deploy.run_dir import BENCH_FILE
from softloop.wire.errors import EXIT_OK, BadConfig, Unavailable

KEEP = "keep"
LOGS = "*.mcap"
GOING = ".removed-"  # in front of a folder's name while it is removed: an interrupted removal is ended by the next one
LOOK_S = 5.0
MIB = 1 << 20


@dataclass(frozen=True)
class RunFolder:
    """One run on the disk: its folder, its size, and when it began, ns of the file system."""

    path: Path
    n_bytes: int
    began_ns: int


def runs_of(bench: Bench) -> list[RunFolder]:
    """The runs of this bench in its `[run] folder` that have a log, the oldest first."""
    found = []
    with suppress(OSError):
        for path in Path(bench.run.folder).iterdir():
            with suppress(OSError):  # gone meanwhile
                if not path.is_symlink() and _bench_of(path) == bench.name and next(path.glob(LOGS), None):
                    found.append(RunFolder(path, size_of(path), (path / BENCH_FILE).stat().st_mtime_ns))
    return sorted(found, key=lambda run: (run.began_ns, run.path.name))


def _bench_of(run: Path) -> str | None:
    """The bench that a folder holds a run of; None for any other folder."""
    try:
        return str(tomllib.loads((run / BENCH_FILE).read_text(encoding="utf-8")).get("name"))
    except (OSError, ValueError):
        return None


def size_of(folder: Path) -> int:
    """Bytes in a folder's files."""
    total = 0
    for path in folder.rglob("*"):
        with suppress(OSError):
            total += path.lstat().st_size if not path.is_dir() else 0
    return total


@contextmanager
def in_use(run_dir: Path) -> Iterator[None]:
    """Nobody removes this run while the block lasts."""
    with (run_dir / BENCH_FILE).open("rb") as file:
        with suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_SH)
        yield


@contextmanager
def claimed(run_dir: Path) -> Iterator[bool]:
    """Have a run for oneself while the block lasts; gives False when it is in use, or is to be kept."""
    with ExitStack() as held:
        try:
            for path in [run_dir / BENCH_FILE, *run_dir.glob(LOGS)]:
                fcntl.flock(held.enter_context(path.open("rb")), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            yield False
        else:
            yield not (run_dir / KEEP).exists()


def remove(run_dir: Path) -> bool:
    """Remove a run, unless it is in use or to be kept; whether it is gone."""
    with claimed(run_dir) as free:
        if not free:
            return False
        going = run_dir.with_name(GOING + run_dir.name)
        try:
            run_dir.rename(going)
        except OSError:
            return False
        shutil.rmtree(going, ignore_errors=True)
    return True


def fit(bench: Bench, budget_bytes: int) -> tuple[list[RunFolder], int]:
    """Remove runs, the oldest first, until the rest fits -> those that went, and the bytes of the rest, which may be too many."""
    for left in Path(bench.run.folder).glob(f"{GOING}*"):
        shutil.rmtree(left, ignore_errors=True)
    runs, gone = runs_of(bench), []
    total = sum(run.n_bytes for run in runs)
    for run in runs:
        if total <= budget_bytes:
            break
        if remove(run.path):
            gone.append(run)
            total -= run.n_bytes
    return gone, total


def make_room(bench: Bench) -> None:
    """Before a run: keep the budget. Raises Unavailable when it is used up and nothing may, or can, be removed."""
    config = bench.recorder
    if config is None or not config.budget_mib:
        return
    budget = config.budget_mib * MIB
    total = sum(run.n_bytes for run in runs_of(bench)) if config.over_budget == "refuse" else fit(bench, budget)[1]
    if total > budget:
        raise Unavailable(
            f"{bench.run.folder}: runs of bench '{bench.name}' hold {total / MIB:.0f} MiB and [recorder] budget_mib is "
            f"{config.budget_mib}: see `softloop log prune`"
        )


@contextmanager
def keeping_budget(bench: Bench, say: Callable[[str], None]) -> Iterator[None]:
    """With `over_budget = "remove"`: keep the budget while the block lasts, beside it. The running log counts, and stays."""
    config = bench.recorder
    if config is None or not config.budget_mib or config.over_budget != "remove":
        yield
        return
    over = threading.Event()
    thread = threading.Thread(target=_keep, args=(bench, config.budget_mib * MIB, say, over), name="rotate", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _keep(bench: Bench, budget_bytes: int, say: Callable[[str], None], over: threading.Event) -> None:
    said = False
    while not over.wait(LOOK_S):
        gone, total = fit(bench, budget_bytes)
        for run in gone:
            say(f"run '{run.path.name}' is removed: {run.n_bytes / MIB:.0f} MiB, for [recorder] budget_mib")
        if total > budget_bytes and not said:
            said = True
            say(f"{total / MIB:.0f} MiB of runs are above [recorder] budget_mib, and none is left that may be removed")


def prune(bench_file: Path, budget_mib: int | None, *, dry: bool) -> int:
    """`softloop log prune`: remove a bench's oldest runs until the rest fits, or say which would go; returns the exit code.

    Raises:
        BadFile, BadConfig: the bench file is wrong, or there is no budget.
        Unavailable: what is left does not fit.
    """
    bench = load_bench(find_bench(bench_file))
    budget = budget_mib if budget_mib is not None else (bench.recorder.budget_mib if bench.recorder else 0)
    if budget_mib is None and not budget:
        raise BadConfig(f"{bench_file}: there is no [recorder] budget_mib; say --budget MIB")
    gone, total = _would_go(bench, budget * MIB) if dry else fit(bench, budget * MIB)
    for run in gone:
        print(f"{'would remove' if dry else 'removed'} {run.path} ({run.n_bytes / MIB:.1f} MiB)")
    print(f"runs of bench '{bench.name}' in {bench.run.folder}: {total / MIB:.1f} MiB of {budget} MiB")
    if total > budget * MIB:
        raise Unavailable(f"{bench.run.folder}: what is left is in use, or holds a file '{KEEP}'")
    return EXIT_OK


def _would_go(bench: Bench, budget_bytes: int) -> tuple[list[RunFolder], int]:
    runs, gone = runs_of(bench), []
    total = sum(run.n_bytes for run in runs)
    for run in runs:
        with claimed(run.path) as free:
            if total > budget_bytes and free:
                gone.append(run)
                total -= run.n_bytes
    return gone, total
