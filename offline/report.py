"""The report of a run: its pictures and tables in one HTML page that needs nothing else, and the pictures as PNG files."""

from __future__ import annotations

import base64
import html
from io import BytesIO
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from softloop.offline.figures import PICTURES
from softloop.offline.log import Log, find_log, open_log
from softloop.offline.summary import MEANINGS, shown, table_rows, write_summary
from softloop.wire.errors import BadFile

REPORT = "report.html"

_CSS = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: #222; background: #fff;
       max-width: 960px; margin: 2.2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.55rem; margin: 0; }
h2 { font-size: 1.1rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid #ddd; padding-bottom: .25rem; }
p.lead { color: #555; margin: .2rem 0 1.2rem; }
table { border-collapse: collapse; width: 100%; font-size: .9rem; }
th, td { text-align: left; padding: .28rem .7rem .28rem 0; border-bottom: 1px solid #eee; vertical-align: top; }
td.value { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
th.value { text-align: right; }
td.remark { color: #666; }
td.key { font-family: ui-monospace, "DejaVu Sans Mono", monospace; font-size: .8rem; overflow-wrap: anywhere; }
.verdict { padding: .55rem .9rem; border-left: 4px solid #009e73; background: #f1f8f5; margin: 1rem 0; }
.verdict.bad { border-color: #d55e00; background: #fdf3ec; }
figure { margin: 1.4rem 0; }
figure img { width: 100%; height: auto; }
figcaption { color: #555; font-size: .87rem; }
pre { background: #f7f7f7; padding: .8rem; font-size: .78rem; line-height: 1.4; overflow-x: auto; white-space: pre-wrap; }
summary { cursor: pointer; color: #0072b2; }
@media print {
  body { max-width: none; margin: 0; font-size: 10.5pt; }
  figure, tr, .verdict { break-inside: avoid; }
  h2 { break-after: avoid; }
  details > summary { display: none; }
}
@page { size: A4; margin: 16mm; }
"""
# The page asks for nothing from anywhere: pictures are in it, and the browser is told to fetch no other thing.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


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
    log = log if log is not None else open_log(path)
    summary = summary if summary is not None else write_summary(path, log)
    folder = path.parent
    pictures = [(name, caption, png_of(draw(log, summary))) for name, caption, draw in PICTURES]
    try:
        for name, _, data in pictures:
            (folder / f"{name}.png").write_bytes(data)
        page = folder / REPORT
        page.write_text(page_of(log, summary, [(caption, data) for _, caption, data in pictures]), encoding="utf-8")
    except OSError as error:
        raise BadFile(f"{folder}: the report cannot be written: {error.strerror or error}") from None
    return page


def png_of(figure: Figure) -> bytes:
    """A figure as PNG; equal figures give equal bytes (no time, no version inside)."""
    stream = BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def page_of(log: Log, summary: dict[str, Any], pictures: list[tuple[str, bytes]]) -> str:
    """The HTML page."""
    title = f"{log.bench or log.path.stem}: {shown(summary['law'])} on {shown(summary['trajectory'])}"
    parts = [
        f"<h1>{_text(title)}</h1>",
        f'<p class="lead">{summary["track_s"]:.1f} s tracked in a run of {summary["run_s"]:.1f} s · {_text(log.path.name)}</p>',
        _verdict(summary),
        _headline(summary),
        "<h2>Pictures</h2>",
        *(_picture(caption, data) for caption, data in pictures),
        "<h2>All figures</h2>",
        _all_figures(summary),
        "<h2>Provenance</h2>",
        _provenance(log),
    ]
    head = f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{_POLICY}"><title>{_text(title)}</title>'
    viewport = '<meta name="viewport" content="width=device-width, initial-scale=1">'
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}{viewport}<style>{_CSS}</style></head>\n<body>\n{body}\n</body></html>\n'
    )


def _text(value: object) -> str:
    return html.escape(str(value))


def _verdict(summary: dict[str, Any]) -> str:
    if summary["evidence_valid"]:
        return '<p class="verdict">Valid evidence: the log is whole, and the plant kept time.</p>'
    return f'<p class="verdict bad"><b>Not valid evidence:</b> {_text(summary["evidence_problems"])}.</p>'


def _headline(summary: dict[str, Any]) -> str:
    rows = "".join(
        f'<tr><td>{_text(what)}</td><td class="value">{_text(value)}</td><td class="remark">{_text(remark)}</td></tr>'
        for what, value, remark in table_rows(summary)
    )
    note = '<p class="lead">Three numbers: median / 99th percentile / maximum.</p>'
    return f'<table><tr><th>figure</th><th class="value">value</th><th>remark</th></tr>{rows}</table>{note}'


def _picture(caption: str, data: bytes) -> str:
    source = base64.b64encode(data).decode()
    image = f'<img alt="{_text(caption)}" src="data:image/png;base64,{source}">'
    return f"<figure>{image}<figcaption>{_text(caption)}</figcaption></figure>"


def _all_figures(summary: dict[str, Any]) -> str:
    rows = "".join(_figure_row(key, summary[key]) for key in summary if key in MEANINGS)
    table = f'<table><tr><th>key in summary.json</th><th class="value">value</th><th>meaning</th></tr>{rows}</table>'
    return f"<details><summary>{len(summary)} figures</summary>{table}</details>"


def _figure_row(key: str, value: Any) -> str:
    place = "<td>" if isinstance(value, str) else '<td class="value">'
    meaning = f'<td class="remark">{_text(MEANINGS[key])}</td>'
    return f'<tr><td class="key">{_text(key)}</td>{place}{_text(shown(value, 3))}</td>{meaning}</tr>'


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
    table = "".join(f'<tr><td>{_text(name)}</td><td class="remark">{_text(value)}</td></tr>' for name, value in rows)
    problems = "".join(f"<li>{_text(p)}</li>" for p in log.problems)
    texts = "".join(
        f"<h3>{_text(name)}</h3><pre>{_text(log.text(name))}</pre>"
        for name in ("bench.toml", "parameters.toml")
        if name in log.attachments
    )
    return f"<table>{table}</table>{f'<h3>Problems of the log</h3><ul>{problems}</ul>' if problems else ''}{texts}"
