"""`softloop parity`: two runs of one excitation against bounds, as a table, JSON and a page."""

from __future__ import annotations

import json
from pathlib import Path

from rich.console import Console
from rich.table import Table

from softloop.offline.compare import labels, set_up_table
from softloop.offline.parity import Parity, as_dict, compare_runs
from softloop.offline.parity_bounds import ParityBounds, load_bounds
from softloop.offline.parity_page import HEADS, cells, write_page
from softloop.offline.run_log import open_run
from softloop.offline.vector import make_folder
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK

WIDTH = 112  # of the table, also where output goes into a file


def judge_parity(run_a: Path, run_b: Path, bounds_file: Path | None, folder: Path, *, as_json: bool) -> int:
    """Compare, print, leave a page in `folder`.

    Returns:
        EXIT_NEGATIVE where a channel is outside its bounds.

    Raises:
        BadFile, BadConfig: a log or the bounds cannot be used, or the runs are not of one excitation.
    """
    bounds = load_bounds(bounds_file)
    a, b = open_run(run_a), open_run(run_b)
    found = compare_runs(a, b, bounds)
    names = labels([run_a, run_b])
    page = write_page(found, bounds, (names[0], names[1]), set_up_table(names, [a, b]), make_folder(folder))
    if as_json:
        print(json.dumps({"a": str(run_a), "b": str(run_b), "page": str(page), **as_dict(found)}, indent=2))
    else:
        show(found, bounds, page)
    return EXIT_OK if found.passed else EXIT_NEGATIVE


def show(found: Parity, bounds: ParityBounds, page: Path) -> None:
    """The table, and a line for each reason."""
    console = Console(highlight=False, width=max(Console().width, WIDTH))
    table = Table(box=None, pad_edge=False)
    for head in HEADS:
        table.add_column(head, justify="left" if head in ("channel", "unit", "verdict") else "right", no_wrap=True)
    for one in found.channels:
        table.add_row(*cells(one, bounds.of(one.signal.name)))
    console.print(table)
    for one in found.channels:
        for reason in one.reasons:
            console.print(f"{one.signal.name}: {reason}", soft_wrap=True)
    console.print(f"{'parity' if found.passed else 'no parity'}; page: {page}", soft_wrap=True)
