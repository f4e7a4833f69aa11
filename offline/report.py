"""The report of a run: pictures and tables in one HTML page that needs nothing else; the pictures also as files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from softloop.offline.figures import PICTURES
from softloop.offline.log import Log
from softloop.offline.page import document, picture, text
from softloop.offline.run_log import find_log, open_run
from softloop.offline.summary import MEANINGS, shown, table_rows, write_summary
from softloop.offline.vector import FORMATS, as_bytes, write

REPORT = "report.html"


def make_report(run: Path | str, log: Log | None = None, summary: dict[str, Any] | None = None) -> Path:
    """Write `report.html`, its pictures and `summary.json` into the run's directory; returns the page.

    Args:
        run: the run's directory, or its log.
        log: the log when it is open already.
        summary: its figures when they are written already.

    Raises:
        BadFile: there is no log, or nothing can be written there.
    """
    path = find_log(run)
    log = log if log is not None else open_run(path)
    summary = summary if summary is not None else write_summary(path, log)
    folder = path.parent
    pictures = []
    for name, caption, draw in PICTURES:
        drawn = draw(log, summary)
        files = {ending: as_bytes(drawn, ending) for ending in FORMATS}
        pictures.append((caption, files["svg"]))
        for ending, data in files.items():
            write(folder / f"{name}.{ending}", data)
    page = folder / REPORT
    write(page, page_of(log, summary, pictures).encode())
    return page


def page_of(log: Log, summary: dict[str, Any], pictures: list[tuple[str, bytes]]) -> str:
    """The HTML page."""
    title = f"{log.bench or log.path.stem}: {shown(summary['law'])} on {shown(summary['trajectory'])}"
    parts = [
        f"<h1>{text(title)}</h1>",
        f'<p class="lead">{summary["track_s"]:.1f} s tracked in a run of {summary["run_s"]:.1f} s · {text(log.path.name)}</p>',
        _verdict(summary),
        _headline(summary),
        "<h2>Pictures</h2>",
        *(picture(caption, data) for caption, data in pictures),
        f'<section class="screen"><h2>All figures</h2>{_all_figures(summary)}</section>',
        "<h2>Provenance</h2>",
        _provenance(log),
    ]
    return document(title, parts)


def _verdict(summary: dict[str, Any]) -> str:
    if summary["evidence_valid"]:
        return '<p class="verdict">Valid evidence: the log is whole, and the plant kept time.</p>'
    return f'<p class="verdict bad"><b>Not valid evidence:</b> {text(summary["evidence_problems"])}.</p>'


def _headline(summary: dict[str, Any]) -> str:
    rows = "".join(
        f'<tr><td>{text(what)}</td><td class="value">{text(value)}</td><td class="remark">{text(remark)}</td></tr>'
        for what, value, remark in table_rows(summary)
    )
    note = '<p class="lead">Three numbers: median / 99th percentile / maximum.</p>'
    return f'<table><tr><th>figure</th><th class="value">value</th><th>remark</th></tr>{rows}</table>{note}'


def _all_figures(summary: dict[str, Any]) -> str:
    rows = "".join(_figure_row(key, summary[key]) for key in summary if key in MEANINGS)
    table = f'<table><tr><th>key in summary.json</th><th class="value">value</th><th>meaning</th></tr>{rows}</table>'
    return f"<details><summary>{len(summary)} figures</summary>{table}</details>"


def _figure_row(key: str, value: Any) -> str:
    place = "<td>" if isinstance(value, str) else '<td class="value">'
    meaning = f'<td class="remark">{text(MEANINGS[key])}</td>'
    return f'<tr><td class="key">{text(key)}</td>{place}{text(shown(value, 3))}</td>{meaning}</tr>'


def _provenance(log: Log) -> str:
    git, versions = log.table("git.json"), log.table("versions.json")
    commit = git.get("commit")
    state = "unknown (not run from a git repository)" if not commit else f"{commit}{', with changes' if git.get('dirty') else ''}"
    rows = [("commit", state), *versions.items()]
    if log.origin is not None:
        rows += [
            ("start on the rig clock, ns", log.origin.clock_ns),
            ("start on the wall clock, ns since 1970", log.origin.wall_ns),
        ]
    table = "".join(f'<tr><td>{text(name)}</td><td class="remark">{text(value)}</td></tr>' for name, value in rows)
    problems = "".join(f"<li>{text(p)}</li>" for p in log.problems)
    texts = "".join(
        f"<h3>{text(name)}</h3><pre>{text(log.text(name))}</pre>"
        for name in ("bench.toml", "parameters.toml")
        if name in log.attachments
    )
    return f"<table>{table}</table>{f'<h3>Problems of the log</h3><ul>{problems}</ul>' if problems else ''}{texts}"
