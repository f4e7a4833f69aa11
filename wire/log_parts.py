"""The files of one log: a recorder that is started again within a run writes a part of its own, and touches none before it."""

from __future__ import annotations

import re
from pathlib import Path

ACCOUNT = "recorder.json"
_NUMBERED = re.compile(r"^(?P<stem>.+)-(?P<number>[2-9]|[1-9]\d+)$")


def part_file(first: Path, number: int) -> Path:
    """The file of part `number`, from 1: `run.mcap`, `run-2.mcap`, ..."""
    return first if number == 1 else first.with_name(f"{first.stem}-{number}{first.suffix}")


def parts_of(first: Path) -> list[Path]:
    """`first` and the parts after it that are there, in their order."""
    found = {}
    for path in first.parent.glob(f"*{first.suffix}"):
        named = _NUMBERED.match(path.stem)
        if named and named["stem"] == first.stem:
            found[int(named["number"])] = path
    return [first, *(found[number] for number in sorted(found))]


def next_part(first: Path) -> Path:
    """The file of the next part: after the last one that is there."""
    if not first.exists() and len(parts_of(first)) == 1:
        return first
    last = parts_of(first)[-1]
    return part_file(first, 2 if last == first else _number_of(last) + 1)


def firsts_among(files: list[Path]) -> list[Path]:
    """Those of `files` that are no later part of another of them."""
    later = {part for file in files for part in parts_of(file)[1:]}
    return [file for file in files if file not in later]


def account_of(file: Path) -> Path:
    """Where the recorder of a part leaves its account: `recorder.json`, `recorder-2.json`, ..., beside the part."""
    named = _NUMBERED.match(file.stem)
    first = file.with_name(ACCOUNT)
    return part_file(first, int(named["number"])) if named and file.with_name(named["stem"] + file.suffix).exists() else first


def _number_of(part: Path) -> int:
    named = _NUMBERED.match(part.stem)
    return int(named["number"]) if named else 1
