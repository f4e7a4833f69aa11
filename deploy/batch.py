"""`softloop batch`: many runs of a bench without its processes, what they come to as a table, as JSON and as a picture."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import zip_longest
from math import isfinite
from pathlib import Path
from time import gmtime, strftime
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from softloop.controller.records import LAWS
from softloop.deploy.bench import Bench, find_bench, load_bench
from softloop.offline.campaign import (
    PAPER,
    Case,
    Result,
    Verdict,
    as_dict,
    case_tables,
    drawn_values,
    paper_limits,
    plan_cases,
    result_dict,
    verdicts,
)
from softloop.offline.closed_loop import RigTables, ready_controller
from softloop.offline.pools import run_here, run_in_processes, run_on_dask
from softloop.wire.errors import EXIT_OK, BadConfig, Unavailable
from softloop.wire.mcap_layout import git_state, versions

_SEEDS = re.compile(r"(\d{1,9})(?::(\d{1,9}))?")
_MOST_SEEDS = 1_000_000
_SHOWN_INFLUENCES = 4
# Score -> its words in the table, and digits.
_WORDS = {
    "max_error_deg": ("max error °", 2),
    "steady_error_deg": ("steady error °", 2),
    "rms_error_deg": ("RMS °", 2),
    "switches_per_s": ("switches /s", 1),
    "peak_deg": ("payload peak °", 2),
    "recovery_s": ("recovery s", 2),
}


@dataclass(frozen=True)
class Wanted:
    """What the command line asks for. Empty `laws` and `trajectories`: the bench's own."""

    seeds: str
    laws: tuple[str, ...] = ()
    trajectories: tuple[str, ...] = ()
    jobs: int = 1
    payload: bool = False
    tuned: bool = False
    scheduler: str | None = None
    out: Path | None = None
    as_json: bool = False


def batch(bench_file: Path, wanted: Wanted) -> int:
    """Run a campaign and leave `batch.json`, `batch.png` and `batch.svg` in its folder. Raises SoftloopError."""
    bench = load_bench(find_bench(bench_file))
    tables = rig_tables(bench)
    seeds = seeds_of(wanted.seeds)
    laws, trajectories = wanted.laws or (tables.controller.law,), wanted.trajectories or (tables.controller.trajectory,)
    check_laws(laws)
    cases = plan_cases(laws, trajectories, seeds, payload=wanted.payload, tuned=wanted.tuned)
    for case in {c.group: c for c in cases}.values():
        ready_controller(case_tables(tables, case)[0].controller)  # what is wrong with it is said before a worker begins
    folder = _make_folder(bench, wanted.out)
    results = _in_order(cases, _work(tables, cases, wanted))
    found = verdicts(results)
    report = _report(bench, found, results)
    _write(folder, report, results)
    if wanted.as_json:
        print(json.dumps(report, indent=2, allow_nan=False))
    else:
        console = Console()
        console.print(summary_table(found))
        console.print("\n".join(["", *worst_rigs(found), f"campaign: {folder}"]), soft_wrap=True, highlight=False)
    return EXIT_OK


def rig_tables(bench: Bench) -> RigTables:
    """The tables that a run without processes needs. Raises BadConfig when one is not in the bench."""
    plant, valves, pressures = bench.plant, bench.valves, bench.pressures
    inclinometer, controller = bench.inclinometer, bench.controller
    if plant is None or valves is None or pressures is None or inclinometer is None or controller is None:
        needed = ("plant", "valves", "pressures", "inclinometer", "controller")
        missing = ", ".join(f"[{name}]" for name in needed if getattr(bench, name) is None)
        raise BadConfig(f"bench '{bench.name}' has no {missing}: a run in one process needs a whole simulated rig")
    return RigTables(controller, plant, valves, pressures, inclinometer, bench.can, bench.pace)


def seeds_of(text: str) -> range:
    """`7` or `0:1000`, the last one not among them. Raises BadConfig."""
    match = _SEEDS.fullmatch(text)
    first = int(match[1]) if match else 0
    end = int(match[2]) if match and match[2] else first + 1
    if not match or not first < end or end - first > _MOST_SEEDS:
        raise BadConfig(f"--seeds '{text}': not a seed such as 7, or a range such as 0:1000 (its last one left out)")
    return range(first, end)


def check_laws(laws: Sequence[str]) -> None:
    """Raises BadConfig when one is not a law of the controller."""
    unknown = [law for law in laws if law not in LAWS]
    if unknown:
        raise BadConfig(f"--law '{unknown[0]}': there is no such law; there are: {', '.join(LAWS)}")


def _make_folder(bench: Bench, asked: Path | None) -> Path:
    folder = asked or Path(bench.run.folder) / f"{bench.name}-batch-{strftime('%Y%m%dT%H%M%SZ', gmtime())}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Unavailable(f"{folder}: cannot be made: {error.strerror or error}") from None
    return folder


def _work(tables: RigTables, cases: list[Case], wanted: Wanted) -> Iterator[Result]:
    """Results as they come, with a progress bar on a terminal."""
    if wanted.scheduler is not None:
        source = run_on_dask(tables, cases, wanted.scheduler)
    elif wanted.jobs > 1:
        source = run_in_processes(tables, cases, wanted.jobs)
    else:
        source = run_here(tables, cases)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with closing(source), Progress(*columns, console=console, transient=True, disable=not sys.stderr.isatty()) as bar:  # type: ignore[type-var]
        task = bar.add_task("runs", total=len(cases))
        for result in source:
            bar.advance(task)
            yield result


def _in_order(cases: list[Case], results: Iterator[Result]) -> list[Result]:
    """However the work was shared out, equal campaigns give equal files."""
    by_case = {result.case: result for result in results}
    return [by_case[case] for case in cases]


def _report(bench: Bench, found: list[Verdict], results: list[Result]) -> dict[str, Any]:
    content = {
        "bench": bench.model_dump(mode="json", exclude_none=True),
        "versions": versions(),
        "git": git_state(Path(__file__).resolve().parent),
        "paper_arc_deg": {name: {"max_error": dynamic, "steady_error": steady} for name, (dynamic, steady) in PAPER.items()},
        "groups": [as_dict(verdict) for verdict in found],
        "runs": [result_dict(result) for result in results],
    }
    return dict(_finite(content))


def _finite(value: Any) -> Any:
    """JSON has no infinity: as text."""
    if isinstance(value, dict):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return str(value) if isinstance(value, float) and not isfinite(value) else value


def _write(folder: Path, report: dict[str, Any], results: list[Result]) -> None:
    from softloop.offline.campaign_figure import distribution  # noqa: PLC0415 - matplotlib, only now that there is something to draw

    figure = distribution(results)
    try:
        (folder / "batch.json").write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        for kind in ("png", "svg"):
            figure.savefig(folder / f"batch.{kind}")
    except OSError as error:
        raise Unavailable(f"{folder}: cannot be written: {error.strerror or error}") from None


def summary_table(found: list[Verdict]) -> Table:
    """A row per group and score."""
    table = Table(title="over all rigs; a lost run counts as infinite", title_justify="left")
    for head in ("", "score", "median", "95 %", "worst", "paper", "under it"):
        table.add_column(head, justify="left" if head in ("", "score") else "right", no_wrap=True)
    for v in found:
        heads = [f"{v.group.law} {v.group.trajectory}", f"{v.rigs} rigs", f"{v.lost} lost"]
        heads[1:1] = ["+ payload"] if v.group.payload else []
        names, limits = [name for name in _WORDS if name in v.spreads], paper_limits(v.group.trajectory)
        for head, name in zip_longest(heads, names):
            limit = f"{limits[name]:.2f}" if name in limits else ""
            cells = _score_cells(v, name) if name else ("",) * 4
            table.add_row(head, *cells, limit, _share_text(v, name), end_section=name == names[-1])
    return table


def _score_cells(v: Verdict, name: str) -> tuple[str, str, str, str]:
    (words, digits), spread = _WORDS[name], v.spreads[name]
    return words, f"{spread.median:.{digits}f}", f"{spread.p95:.{digits}f}", f"{spread.worst:.{digits}f}"


def _share_text(v: Verdict, name: str) -> str:
    return f"{100.0 * v.under_paper[name]:.1f} %" if name in v.under_paper else ""


def worst_rigs(found: list[Verdict]) -> Iterator[str]:
    """Each group's worst rig, which draws go with large errors over all rigs, and what the worst ones were drawn with."""
    for v in found:
        worst, name = v.worst, f"{v.group.law} on {v.group.trajectory}" + (" with payload" if v.group.payload else "")
        why = f"lost ({worst.fault or 'not completed'})" if v.lost else f"{worst.scores.max_error_deg:.2f}°"
        both = f"; under all of the paper's: {100.0 * v.under_paper['both']:.1f} %" if v.under_paper else ""
        yield f"{name}: worst rig is seed {worst.case.seed}: {why}{both}"
        if v.influences:
            shown = ", ".join(f"{key} {rank:+.2f}" for key, rank in v.influences[:_SHOWN_INFLUENCES])
            yield f"  rank correlation of draws with the largest error: {shown}"
    for seed in sorted({v.worst.case.seed for v in found}):
        yield f"seed {seed} was drawn with: " + ", ".join(f"{key} {value:.3g}" for key, value in drawn_values(seed).items())
