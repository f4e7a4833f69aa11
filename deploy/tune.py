"""`softloop tune`: the search with its progress, and the file that it leaves."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, TextColumn

from softloop.deploy.destination import check_destination
from softloop.offline.tuning import Latency, as_toml, summary, tune
from softloop.offline.tuning_ranges import RANGES
from softloop.wire.errors import EXIT_OK, BadConfig, BadFile


def seeds_of(text: str) -> tuple[int, ...]:
    """The seeds of "FIRST:END" (END not among them), or of one number. Raises BadConfig."""
    first, _, end = text.partition(":")
    try:
        seeds = range(int(first), int(end)) if end else range(int(first), int(first) + 1)
    except ValueError:
        seeds = range(0)
    if not seeds or seeds[0] < 0:
        raise BadConfig(f"seeds '{text}': give FIRST:END with 0 <= FIRST < END, such as 0:20, or one number")
    return tuple(seeds)


def _write(out: Path, text: str) -> None:
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise BadFile(f"--out {out}: cannot be written: {error.strerror or error}") from None


def run_tune(
    law: str, seeds: str, added_ms: float, evaluations: int, search_seed: int, out: Path | None, *, as_json: bool
) -> int:
    """Search, write the gains to `out` (or print them). Raises BadConfig, or BadFile before the search where `out` cannot be."""
    if law not in RANGES:
        raise BadConfig(f"law '{law}' cannot be tuned; these can: {', '.join(RANGES)}")
    rigs = seeds_of(seeds)
    if out is not None:
        check_destination(out, "--out")
    with Progress(
        *Progress.get_default_columns(), TextColumn("best {task.fields[best]}"), console=Console(stderr=True), transient=True,
        disable=not sys.stderr.isatty(),
    ) as bar:  # fmt: skip
        task = bar.add_task(f"tuning {law}", total=evaluations, best="-")

        def show(done: int, total: int, best: float) -> None:
            bar.update(task, completed=done, total=total, best=f"{best:.3f}")

        found = tune(law, Latency(added_ms), rigs, evaluations, search_seed, show)
    if out is not None:
        _write(out, as_toml(found))
    if as_json:
        print(json.dumps(summary(found)))
    elif out is None:
        print(as_toml(found), end="")
    else:
        print(f"{law}: cost {found.cost:.3f} after {found.evaluations} evaluations, gains in {out}")
    return EXIT_OK
