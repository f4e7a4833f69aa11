"""`softloop compare`: several runs on one page."""

from __future__ import annotations

from pathlib import Path

from softloop.offline.compare import compare
from softloop.wire.errors import EXIT_OK


def compare_runs(runs: list[Path], folder: Path) -> int:
    """Compare runs into a folder and print the page's path. Raises BadConfig, BadFile."""
    print(compare(runs, folder))
    return EXIT_OK
