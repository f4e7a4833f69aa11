"""`softloop shadow`: the simulated plant of a bench's `[shadow]` along a log, and how far the two were apart."""

from __future__ import annotations

import json
from pathlib import Path

from rich.console import Console
from rich.table import Table

from softloop.deploy.bench import find_bench, load_bench, process_config
from softloop.deploy.progress import counted_progress
from softloop.offline.run_log import open_run
from softloop.offline.shadow_log import content, figures, follow
from softloop.wire.errors import EXIT_OK, BadConfig


def follow_run(bench_file: Path, run: Path, *, as_json: bool) -> int:
    """Follow, and print RMS and largest residual of each channel; with `as_json` each word of the shadow too.

    Raises BadFile or BadConfig when bench, log or parameters cannot be used.
    """
    bench = load_bench(find_bench(bench_file))
    if bench.shadow is None:
        raise BadConfig(f"{bench_file}: has no table [shadow], which says what plant is to follow; see docs/parity.md")
    with counted_progress("following the log", quiet=as_json) as progress:
        said = follow(open_run(run), process_config(bench, "shadow"), progress)
    found = figures(said)
    if as_json:
        print(json.dumps({"run": str(run), "figures": found, "said": content(said)}))
    else:
        show(found, len(said))
    return EXIT_OK


def show(found: dict[str, dict[str, float]], words: int) -> None:
    """The table."""
    table = Table(box=None, pad_edge=False)
    for head in ("rig less shadow", "RMS", "largest"):
        table.add_column(head, justify="left" if head.startswith("rig") else "right", no_wrap=True)
    for name, figure in found.items():
        table.add_row(name, f"{figure['rms']:.4g}", f"{figure['most']:.4g}")
    console = Console(highlight=False)
    console.print(table)
    console.print(f"{words} words of the shadow")
