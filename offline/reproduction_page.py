"""The page of `softloop reproduce`: what the paper prints beside what our runs gave, each number with the log it came from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from html import escape

from softloop.offline.page import document, picture, text

DASH = "\N{EN DASH}"


@dataclass(frozen=True)
class Row:
    """One row of a table.

    Attributes:
        cells: its texts.
        source: where its numbers come from: a log's path, relative to the page, or words.
        link: `source` is a path.
    """

    cells: tuple[str, ...]
    source: str
    link: bool = True


@dataclass(frozen=True)
class TableOf:
    """A table; every row ends with its source."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[Row, ...]
    note: str = ""


@dataclass(frozen=True)
class Picture:
    """A figure of the page, as SVG, with its sources."""

    caption: str
    svg: bytes


@dataclass
class Section:
    """A part of the page."""

    title: str
    lead: str = ""
    parts: list[TableOf | Picture] = field(default_factory=list)


@dataclass(frozen=True)
class LogEntry:
    """One log that the page speaks of."""

    path: str
    sha256: str
    valid: str


def page_of(title: str, lead: str, sections: Sequence[Section], logs: Sequence[LogEntry], provenance: dict[str, str]) -> str:
    """The HTML page."""
    parts = [f"<h1>{text(title)}</h1>", f'<p class="lead">{text(lead)}</p>']
    for section in sections:
        parts.append(f"<h2>{text(section.title)}</h2>")
        parts += [f'<p class="lead">{text(section.lead)}</p>'] if section.lead else []
        parts += [_part(part) for part in section.parts]
    parts += ["<h2>Logs</h2>", _logs(logs), "<h2>Provenance</h2>", _plain(provenance.items())]
    return document(title, parts)


def _part(part: TableOf | Picture) -> str:
    return picture(part.caption, part.svg) if isinstance(part, Picture) else _table(part)


def _table(table: TableOf) -> str:
    heads = "".join(f"<th{'' if i == 0 else ' class=value'}>{text(head)}</th>" for i, head in enumerate(table.heads))
    rows = "".join(f"<tr>{_cells(row)}<td class=remark>{_source(row)}</td></tr>" for row in table.rows)
    note = f'<p class="lead">{text(table.note)}</p>' if table.note else ""
    return f"<h3>{text(table.title)}</h3><table><tr>{heads}<th>from</th></tr>{rows}</table>{note}"


def _cells(row: Row) -> str:
    return "".join(f"<td{'' if i == 0 else ' class=value'}>{text(cell)}</td>" for i, cell in enumerate(row.cells))


def _source(row: Row) -> str:
    return f'<a href="{escape(row.source, quote=True)}">{text(row.source)}</a>' if row.link else text(row.source)


def _logs(logs: Sequence[LogEntry]) -> str:
    rows = "".join(
        f'<tr><td><a href="{escape(entry.path, quote=True)}">{text(entry.path)}</a></td>'
        f"<td class=key>{text(entry.sha256)}</td><td class=remark>{text(entry.valid)}</td></tr>"
        for entry in logs
    )
    return f"<table><tr><th>log</th><th>SHA-256</th><th>valid evidence</th></tr>{rows}</table>"


def _plain(rows: Iterable[tuple[str, str]]) -> str:
    return (
        f"<table>{''.join(f'<tr><td>{text(name)}</td><td class=remark>{text(value)}</td></tr>' for name, value in rows)}</table>"
    )


def number(value: float | None, digits: int = 2) -> str:
    """A number as text; a dash where there is none."""
    return DASH if value is None else f"{value:.{digits}f}"


def figures(value: float | None, digits: int = 5) -> str:
    """Likewise with so many significant figures."""
    return DASH if value is None else f"{value:.{digits}g}"
