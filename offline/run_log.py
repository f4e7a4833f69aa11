"""The log of a run as one, in however many parts: a recorder that died and was started again wrote another."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softloop.offline.log import Log, open_log
from softloop.wire.errors import BadFile
from softloop.wire.log_parts import firsts_among, parts_of


def find_log(run: Path | str) -> Path:
    """The log of a run: the file itself, or (the first part of) the one in its directory. Raises BadFile on none or several."""
    path = Path(run)
    if not path.is_dir():
        return path
    found = firsts_among(sorted(path.glob("*.mcap")))
    if len(found) != 1:
        names = ", ".join(f.name for f in found) or "none"
        raise BadFile(f"{path}: a run's directory holds one .mcap log; here: {names}")
    return found[0]


def open_run(run: Path | str) -> Log:
    """Read all of a run's log: its directory, or the log's first file; a later part by its own name is read alone.

    Raises BadFile when there is no such log, or nothing of it can be read.
    """
    return joined(open_parts(run))


def open_parts(run: Path | str) -> list[Log]:
    """The parts of a run's log, in their order; one that is no MCAP at all is empty and says so. Raises as `open_run`."""
    files = parts_of(find_log(run))
    if len(files) == 1:
        return [open_log(files[0])]
    return [_readable(file) for file in files]


def _readable(file: Path) -> Log:
    """A recorder that was killed in its first moment leaves a file of no use."""
    try:
        return open_log(file)
    except BadFile as error:
        return Log(file, problems=[str(error)], finished=False)


def joined(parts: Sequence[Log]) -> Log:
    """One log of all parts: messages one after the other; what describes the run, from the first that has it."""
    if len(parts) == 1:
        return parts[0]
    whole = Log(parts[0].path, origin=next((p.origin for p in parts if p.origin), None), finished=parts[-1].finished)
    for part in reversed(parts):
        whole.attachments |= part.attachments
        whole.metadata |= part.metadata
    for part in parts:
        whole.problems += [f"{part.path.name}: {problem}" for problem in part.problems]
        whole.problems += [
            *_append(whole.channels, part.channels, part.path.name),
            *_append(whole.can, part.can, part.path.name),
        ]
    return whole


def _append(whole: dict[Any, NDArray[Any]], part: dict[Any, NDArray[Any]], name: str) -> list[str]:
    """Put each array of `part` behind that of `whole`; returns what cannot be."""
    problems = []
    for key, records in part.items():
        before = whole.get(key)
        if before is None:
            whole[key] = records
        elif before.dtype == records.dtype:
            whole[key] = np.concatenate([before, records])
        else:
            problems.append(f"{name}: {len(records)} messages of {key} are of another definition, left out")
    return problems
