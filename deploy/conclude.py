"""After a run: the summary that programs read, the table and the report that people look at, and one last line."""

from __future__ import annotations

import sys
from pathlib import Path

from softloop.deploy.bench import Bench
from softloop.wire.errors import EXIT_OK, SoftloopError


def conclude(bench: Bench, run_dir: Path, code: int, text: str, *, began: bool, quiet: bool) -> int:
    """Summary and report of a run that `began` and ended with `code`, and a word on how it ended; returns the exit code."""
    if began and bench.recorder is not None:
        try:
            judge(run_dir / bench.recorder.file, report=bench.run.report, quiet=quiet)
        except SoftloopError as error:  # a log that cannot be judged changes nothing else
            sys.stderr.write(f"softloop: no summary: {error}\n")
    if code != EXIT_OK:
        sys.stderr.write(f"softloop: {text}\n")
    if not quiet:
        print(f"{text}\nrun: {run_dir}" if code == EXIT_OK else f"run: {run_dir}", flush=True)
    return code


def judge(run: Path, *, report: bool, quiet: bool) -> None:
    """Write `summary.json`, and with `report` the page and its pictures, from a run's directory or its log.

    Raises:
        BadFile: there is no log, or nothing can be written beside it.
    """
    from rich.console import Console  # noqa: PLC0415 - what follows brings numba and matplotlib: only once the rig has stopped

    from softloop.offline.report import make_report  # noqa: PLC0415
    from softloop.offline.run_log import open_run  # noqa: PLC0415
    from softloop.offline.summary import summary_table, write_summary  # noqa: PLC0415

    log = open_run(run)
    summary = write_summary(run, log)
    page = make_report(run, log, summary) if report else None
    if not summary["evidence_valid"]:
        sys.stderr.write(f"softloop: this run is not valid evidence: {summary['evidence_problems']}\n")
    if quiet:
        return
    console = Console()
    console.print(summary_table(summary))
    if page is not None:
        pictures = ", ".join(sorted(p.name for p in page.parent.glob("*.png")))
        console.print(f"report: {page}\npictures beside it, also as PDF: {pictures}", soft_wrap=True, highlight=False)
