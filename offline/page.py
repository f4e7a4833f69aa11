"""What the HTML pages of `report` and `compare` share: a page that needs nothing else, and prints well."""

from __future__ import annotations

import base64
import html

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
span.key { white-space: normal; }
td.remark { color: #666; }
td.key, span.key { font-family: ui-monospace, "DejaVu Sans Mono", monospace; font-size: .8rem; overflow-wrap: anywhere; }
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
  .screen { display: none; }
}
@page { size: A4; margin: 16mm; }
"""
# The page asks for nothing from anywhere: pictures are in it, and the browser is told to fetch no other thing.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def text(value: object) -> str:
    """A value as text of a page: nothing in it can become markup."""
    return html.escape(str(value))


def document(title: str, parts: list[str]) -> str:
    """The whole page around its parts."""
    head = f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{_POLICY}"><title>{text(title)}</title>'
    viewport = '<meta name="viewport" content="width=device-width, initial-scale=1">'
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}{viewport}<style>{_CSS}</style></head>\n<body>\n{body}\n</body></html>\n'
    )


def picture(caption: str, svg: bytes) -> str:
    """A picture in the page, as vectors, with its caption."""
    image = f'<img alt="{text(caption)}" src="data:image/svg+xml;base64,{base64.b64encode(svg).decode()}">'
    return f"<figure>{image}<figcaption>{text(caption)}</figcaption></figure>"


def table(head: list[str], rows: list[list[str]]) -> str:
    """Rows of cells that are markup already, but for the first of each; the heads are text."""
    titles = "".join(f"<th{'' if i == 0 else ' class=value'}>{text(title)}</th>" for i, title in enumerate(head))
    body = "".join(
        f"<tr><td>{text(name)}</td>{''.join(f'<td class=value>{cell}</td>' for cell in cells)}</tr>" for name, *cells in rows
    )
    return f"<table><tr>{titles}</tr>{body}</table>"
