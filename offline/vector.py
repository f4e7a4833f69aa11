"""A figure as a file for print: SVG, PDF or PNG; equal figures give equal bytes (no time, no version inside)."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from softloop.wire.errors import BadConfig, BadFile

FORMATS = ("svg", "pdf", "png")
_METADATA: dict[str, Any] = {
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    "png": {"Software": None},
}
# Letters as outlines in SVG, so that it looks the same everywhere; as TrueType fonts in PDF, which journals ask for.
_STYLE: Any = {"svg.hashsalt": "softloop", "svg.fonttype": "path", "pdf.fonttype": 42, "path.simplify_threshold": 0.2}


def as_bytes(figure: Figure, ending: str) -> bytes:
    """The figure in a format of `FORMATS`."""
    stream = BytesIO()
    with mpl.rc_context(_STYLE):
        figure.savefig(stream, format=ending, metadata=_METADATA[ending])
    return stream.getvalue()


def save(figure: Figure, target: Path) -> Path:
    """Write a figure in the format of the file's ending. Raises BadConfig on another ending, and as `write` does."""
    write(target, as_bytes(figure, format_of(target)))
    return target


def format_of(target: Path) -> str:
    """One of `FORMATS`, as the file's ending says. Raises BadConfig on another ending."""
    ending = target.suffix.removeprefix(".").lower()
    if ending not in FORMATS:
        raise BadConfig(f"{target}: the ending says the format, one of: {', '.join('.' + f for f in FORMATS)}")
    return ending


def write(target: Path, data: bytes) -> None:
    """Write a file. Raises BadFile with one line."""
    try:
        target.write_bytes(data)
    except OSError as error:
        raise BadFile(f"{target}: cannot be written: {error.strerror or error}") from None


def make_folder(folder: Path) -> Path:
    """Make a folder for figures and pages, where it is not there yet. Raises BadFile with one line."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadFile(f"{folder}: cannot be made: {error.strerror or error}") from None
    return folder
