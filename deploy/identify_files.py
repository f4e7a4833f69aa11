"""The files that `softloop identify` is given: a name for each that no other has, and which of them are the same data."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from softloop.deploy.identify_words import say, say_faults
from softloop.offline.identification.csv_map import Map, read_csv, read_vent
from softloop.offline.identification.experiments import halves
from softloop.offline.identification.series import Series, from_log
from softloop.offline.identification.venting import Vent
from softloop.offline.run_log import find_log, open_run
from softloop.offline.summary import judged
from softloop.wire.errors import BadFile
from softloop.wire.log_parts import parts_of

HALVES = ("Data1", "Data2")


@dataclass(frozen=True)
class Data:
    """What trains, what the model is tried on, and the names of those among these that the training has seen after all."""

    train: Series
    validate: list[Series]
    seen: frozenset[str]


@dataclass(frozen=True)
class Vents:
    """The same of ventings, of which several may train."""

    train: list[Vent]
    validate: list[Vent]
    seen: frozenset[str]


def of_runs(runs: Sequence[Path]) -> Data:
    """Logs: the halves of the first one are Data1, which trains, and Data2. Raises BadFile."""
    names = labels(runs, ending=True, taken=HALVES)
    series = [_of_run(run, name) for run, name in zip(runs, names, strict=True)]
    first, second = halves(series[0])
    return Data(first, [second, *series[1:]], _seen(names, [digest_of(run) for run in runs], 1))


def of_tables(files: Sequence[Path], columns: Map) -> Data:
    """CSV files: the first one trains. Raises BadFile."""
    names = labels(files, ending=False)
    series = [replace(read_csv(file, columns, say), name=name) for file, name in zip(files, names, strict=True)]
    return Data(series[0], series[1:], _seen(names, [_digest([file]) for file in files], 1))


def of_vents(files: Sequence[Path], columns: Map, trained: int) -> Vents:
    """CSV files of ventings: the first `trained` of them train. Raises BadFile."""
    names = labels(files, ending=False)
    runs = [replace(read_vent(file, columns, say), name=name) for file, name in zip(files, names, strict=True)]
    return Vents(runs[:trained], runs[trained:], _seen(names, [_digest([file]) for file in files], trained))


def _of_run(run: Path, name: str) -> Series:
    """A logged run as a series; what its log is not good for is said beforehand."""
    log = open_run(run)
    series = from_log(log, name)
    say_faults(name, *judged(log))
    return series


def _seen(names: Sequence[str], digests: Sequence[str], trained: int) -> frozenset[str]:
    """Names of the data after the first `trained` that are the same as one of those."""
    return frozenset(n for n, digest in zip(names[trained:], digests[trained:], strict=True) if digest in digests[:trained])


def labels(files: Sequence[Path], *, ending: bool, taken: Sequence[str] = ()) -> list[str]:
    """A name for each file: its own, with so many of its folders as tell it from the others; `taken` are not free."""
    parts = [_parts(file, ending=ending) for file in files]
    depth = dict.fromkeys(parts, 1)  # a file that is given twice is here once
    for _ in range(max(map(len, parts), default=0)):
        count = Counter([*("/".join(p[-d:]) for p, d in depth.items()), *taken])
        depth = {p: d + (count["/".join(p[-d:])] > 1) for p, d in depth.items()}
    return _numbered(["/".join(p[-depth[p] :]) for p in parts], taken)


def _parts(file: Path, *, ending: bool) -> tuple[str, ...]:
    whole = file.resolve() if file.name in ("", "..") else file.absolute()
    return (*whole.parts[1:-1], whole.name if ending else whole.stem)


def _numbered(names: Sequence[str], taken: Sequence[str]) -> list[str]:
    """One file that is given twice, or two that differ in their ending alone."""
    seen: Counter[str] = Counter(taken)
    out = []
    for name in names:
        seen[name] += 1
        out.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return out


def digest_of(run: Path) -> str:
    """SHA-256 of all parts of a run's log. Raises BadFile."""
    return _digest(parts_of(find_log(run)))


def _digest(files: Sequence[Path]) -> str:
    try:
        return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    except OSError as error:
        raise BadFile(f"{files[0]}: cannot be read: {error.strerror or error}") from None
