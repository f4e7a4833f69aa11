"""Where a command is to write a file, looked at before it works for minutes and not only after."""

from __future__ import annotations

import os
from pathlib import Path

from softloop.wire.errors import BadFile


def check_destination(file: Path, option: str) -> None:
    """A file can be written there; none is made. Raises BadFile."""
    folder = file.parent
    if file.is_dir():
        raise BadFile(f"{option} {file}: is a folder; name a file")
    if not folder.is_dir():
        raise BadFile(f"{option} {file}: there is no folder {folder}; make it first")
    if not os.access(file if file.exists() else folder, os.W_OK):
        raise BadFile(f"{option} {file}: cannot be written: no permission")
