"""After a run: the summary that programs read, the table and the report that people look at, and one last line."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from softloop.deploy.bench import Bench
from softloop.wire.errors import EXIT_OK, SoftloopError


def conclude(bench: Bench, run_dir: Path, code: int, text: str, *, quiet: bool) -> int:
    """Summary and report of a run that ended with `code`, and say how it ended; returns the exit code."""
    if bench.recorder is not None:
        _summarise(run_dir / bench.recorder.file, report=bench.run.report, quiet=quiet)
    if code != EXIT_OK:
        sys.stderr.write(f"softloop: {text}\n")
    elif not quiet:
        print(text)
    if not quiet:
        print(f"run: {run_dir}")
    return code


def _summarise(log: Path, *, report: bool, quiet: bool) -> None:
    """What the log yields. A log that cannot be judged is said in one line and changes nothing else."""
    try:
        judge(log, report=report, quiet=quiet)
    except SoftloopError as error:
        sys.stderr.write(f"softloop: no summary: {error}\n")
