"""Several runs side by side: figures, what differs in their set-up, and pictures that lay them over each other."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from softloop.offline.compare_figures import Shown, distribution, lateness, tracking
from softloop.offline.log import Log
from softloop.offline.metrics import SENSORS
from softloop.offline.page import document, picture, table, text
from softloop.offline.run_log import open_run
from softloop.offline.summary import NONE, Value, shown, summarise
from softloop.offline.vector import as_bytes, make_folder, write
from softloop.wire.errors import BadConfig, BadFile

PAGE = "compare.html"
RUNS_MAX = 6
COMMIT_LETTERS = 12
# Name in the table, key in summary.json, digits, and whether less is better (None: neither).
ROWS: tuple[tuple[str, str, int, bool | None], ...] = (
    ("maximum error, true angle (°)", "truth_error_max_deg", 2, True),
    ("steady error, last 2 s of dwells (°)", "truth_error_steady_deg", 2, True),
    ("RMS error, true angle (°)", "truth_error_rms_deg", 3, True),
    ("maximum error, inclinometer (°)", "sensor_error_max_deg", 2, True),
    ("RMS error, inclinometer (°)", "sensor_error_rms_deg", 3, True),
    ("RMS pressure error (kPa)", "pressure_error_rms_kpa", 2, True),
    ("mode switches (1/s)", "mode_switches_per_s", 1, None),
    ("ticks at a limit (%)", "saturated_percent", 1, None),
    ("tick lateness, median (µs)", "tick_late_p50_us", 0, True),
    ("tick lateness, 99.9 % (µs)", "tick_late_p99_9_us", 0, True),
    ("ticks skipped", "ticks_skipped", 0, True),
    *((f"{sensor} to coil, median (µs)", f"latency_{sensor}_total_p50_us", 0, True) for sensor in SENSORS),
    ("plant late, worst (ms)", "plant_late_max_ms", 2, None),
    ("gate faults", "gate_faults", 0, True),
    ("tracked (s)", "track_s", 1, None),
    ("valid evidence", "evidence_valid", 0, None),
)
PICTURES: tuple[tuple[str, str, Callable[[list[Shown]], Figure]], ...] = (
    ("compare_tracking", "Angle and error of each run over the time on its trajectory.", tracking),
    ("compare_errors", "Share of the tracked time in which the error was larger than a value: lower is better.", distribution),
    ("compare_lateness", "Share of ticks that woke later than a value.", lateness),
)


@dataclass(frozen=True)
class Run:
    """One of the runs: its label, its log, its figures."""

    label: str
    log: Log
    summary: dict[str, Value]


def read_runs(paths: list[Path]) -> list[Run]:
    """Open and summarise runs. Raises BadConfig when there are fewer than two or too many, BadFile when one cannot be read."""
    if not 2 <= len(paths) <= RUNS_MAX:
        raise BadConfig(f"two to {RUNS_MAX} runs can be compared (got {len(paths)})")
    runs = []
    for label, path in zip(labels(paths), paths, strict=True):
        log = open_run(path)
        if not len(log["cycle"]):
            raise BadFile(f"{path}: no cycle record was logged, so there is nothing to compare")
        runs.append(Run(label, log, summarise(log)))
    return runs


def labels(paths: list[Path]) -> list[str]:
    """A short name for each run: that of its directory; with a number where two are the same."""
    names = [path.resolve().name if path.is_dir() else path.resolve().parent.name for path in paths]
    return [name if names.count(name) == 1 else f"{name} ({names[: i + 1].count(name)})" for i, name in enumerate(names)]


def compare(paths: list[Path], folder: Path) -> Path:
    """Write `compare.html` and its pictures (SVG, PDF) into `folder`; returns the page. Raises BadConfig, BadFile."""
    runs = read_runs(paths)
    make_folder(folder)
    pictures = []
    for name, caption, draw in PICTURES:
        drawn = draw([Shown(run.label, run.log) for run in runs])
        svg = as_bytes(drawn, "svg")
        write(folder / f"{name}.svg", svg)
        write(folder / f"{name}.pdf", as_bytes(drawn, "pdf"))
        pictures.append(picture(caption, svg))
    target = folder / PAGE
    write(target, page_of(runs, pictures).encode())
    return target


def page_of(runs: list[Run], pictures: list[str]) -> str:
    """The HTML page."""
    title = f"Comparison of {len(runs)} runs"
    parts = [
        f"<h1>{title}</h1>",
        f'<p class="lead">{text(", ".join(run.label for run in runs))}</p>',
        *_warnings(runs),
        table(["figure", *(run.label for run in runs)], _figure_rows(runs)),
        '<p class="lead">Bold: the best of its row, where less is better and they are not the same.</p>',
        "<h2>Pictures</h2>",
        *pictures,
        "<h2>What differs in their set-up</h2>",
        set_up_table([run.label for run in runs], [run.log for run in runs]),
    ]
    return document(title, parts)


def _warnings(runs: list[Run]) -> list[str]:
    bad = [run for run in runs if not run.summary["evidence_valid"]]
    followed = {str(run.summary["trajectory"]) for run in runs}
    apart = ['<p class="verdict bad">The runs follow different trajectories: their errors do not compare.</p>']
    return (apart if len(followed) > 1 else []) + [
        f'<p class="verdict bad"><b>{text(run.label)} is not valid evidence:</b> {text(run.summary["evidence_problems"])}.</p>'
        for run in bad
    ]


def _figure_rows(runs: list[Run]) -> list[list[str]]:
    rows = [["law", *(text(shown(run.summary["law"])) for run in runs)]]
    rows.append(["trajectory", *(text(_name(run.summary["trajectory"])) for run in runs)])
    for name, key, digits, less in ROWS:
        values = [run.summary[key] for run in runs]
        best = best_of(values) if less else None
        cells = [f"<b>{text(shown(v, digits))}</b>" if best is not None and v == best else text(shown(v, digits)) for v in values]
        rows.append([name, *cells])
    return rows


def _name(trajectory: Value) -> str:
    """Of a file its name alone."""
    return Path(str(trajectory)).name if trajectory else NONE


def best_of(values: list[Value]) -> float | None:
    """The least of the numbers; None when there are not two, or when all are the same."""
    numbers = [float(v) for v in values if isinstance(v, int | float) and not isinstance(v, bool)]
    return min(numbers) if len(numbers) > 1 and min(numbers) < max(numbers) else None


def set_up_table(names: list[str], logs: list[Log]) -> str:
    """What differs in the set-up of runs, as markup."""
    found = differences([set_up(log) for log in logs])
    if not found:
        return '<p class="lead">Nothing: bench file, parameters, versions and commit are the same.</p>'
    rows = [[key, *(f'<span class="key">{text(value)}</span>' for value in values)] for key, values in found]
    return table(["key", *names], rows)


def set_up(log: Log) -> dict[str, str]:
    """Everything a run was set up with, dotted key -> text: bench file, parameters, versions, commit."""
    found: dict[str, str] = {}
    for name, prefix in (("bench.toml", ""), ("parameters.toml", "parameters.")):
        try:
            _flatten(tomllib.loads(log.text(name)), prefix, found)
        except tomllib.TOMLDecodeError:
            found[f"{prefix}(file)"] = "cannot be read"
    _flatten(log.table("versions.json"), "versions.", found)
    _flatten(log.table("git.json"), "git.", found)
    if "git.commit" in found:
        found["git.commit"] = found["git.commit"][:COMMIT_LETTERS]
    return found


def _flatten(content: dict[str, Any], prefix: str, found: dict[str, str]) -> None:
    for key, value in content.items():
        if isinstance(value, dict):
            _flatten(value, f"{prefix}{key}.", found)
        else:
            found[f"{prefix}{key}"] = str(value)


def differences(tables: list[dict[str, str]]) -> list[tuple[str, list[str]]]:
    """(key, value of each) of the keys that are not the same in all; addresses that follow the run's directory are left out."""
    keys = sorted({key for table in tables for key in table})
    rows = [(key, [table.get(key, NONE) for table in tables]) for key in keys if key not in _OF_THE_RUN]
    return [(key, values) for key, values in rows if len(set(values)) > 1]


# They name the run's own directory or port, in every run another.
_OF_THE_RUN = {"plant.serial", "inclinometer.port", "name"}
