"""`softloop log check` and `softloop log repair`: what was found, said to a person or as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from softloop.offline.log_check import LogCheck, check_log
from softloop.offline.log_repair import KEPT_AS, repair_log
from softloop.offline.run_log import find_log, joined, open_parts
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK

GAPS_SHOWN = 12


def check_run(run: Path, *, as_json: bool) -> int:
    """Say what a log holds and what is missing in it; EXIT_NEGATIVE when something is. Raises BadFile."""
    parts = open_parts(run)
    of_parts = [(part.path, check_log(part)) for part in parts]
    file, found = parts[0].path, check_log(joined(parts))
    if as_json:
        content = {"log": str(file), "whole": found.whole, "missing": found.missing, **asdict(found)}
        print(json.dumps(content | {"parts": [_of_part(path, part) for path, part in of_parts]}, indent=2))
    else:
        print("\n".join([*_parts_said(of_parts), f"{file}: {_word(found)}", *_said(found)]))
    return EXIT_OK if found.whole else EXIT_NEGATIVE


def _word(found: LogCheck) -> str:
    return "whole" if found.whole else "not whole"


def _of_part(path: Path, found: LogCheck) -> dict[str, Any]:
    messages = sum(held.messages for held in found.held)
    starts_s = min((held.first_s for held in found.held), default=0.0)
    kept = {"log": str(path), "whole": found.whole, "finished": found.finished, "messages": messages, "missing": found.missing}
    return kept | {"length_s": found.ends_s - starts_s, "problems": found.problems}


def _parts_said(of_parts: list[tuple[Path, LogCheck]]) -> Iterator[str]:
    """A line for each part of a log that has several; what follows is of all together."""
    if len(of_parts) == 1:
        return
    yield f"{len(of_parts)} parts: the recorder was started again"
    for path, found in of_parts:
        of = _of_part(path, found)
        yield f"  {path.name}: {_word(found)}, {of['messages']} messages over {of['length_s']:.3f} s, {found.missing} missing"


def _said(found: LogCheck) -> Iterator[str]:
    yield from found.problems
    width = max((len(held.topic) for held in found.held), default=0)
    for held in found.held:
        yield f"  {held.topic:{width}}  {held.messages:8d} messages, {held.first_s:.3f} s to {held.last_s:.3f} s"
    for topic, sender, number in found.restarts:
        yield f"{topic}{_who(sender)}: counted anew from {number}"
    for gap in found.gaps[:GAPS_SHOWN]:
        where = f"between {gap.after_s:.3f} s and {gap.before_s:.3f} s"
        yield f"{gap.topic}{_who(gap.sender)}: {gap.missing} missing, {gap.first} to {gap.last}, {where}"
    if len(found.gaps) > GAPS_SHOWN:
        yield f"and {len(found.gaps) - GAPS_SHOWN} more gaps (all of them with --json)"
    for start, end in found.windows:
        yield f"loss window: {start:.3f} s to {end:.3f} s"
    if not found.finished:
        yield f"loss window: {found.ends_s:.3f} s to the end of the run; the recorder did not end its file"


def _who(sender: int) -> str:
    return f" of sender {sender}" if sender else ""


def repair_run(run: Path, output: Path | None) -> int:
    """Write a good file from a damaged log. Raises BadFile, Unavailable."""
    file, parts = find_log(run), open_parts(run)
    if output is None and len(parts) == 1 and not parts[0].problems:
        print(f"{file}: nothing to repair")
        return EXIT_OK
    made = repair_log(file, output)
    left = f"; {made.left_out} damaged places left out" if made.left_out else ""
    names = ", ".join(part.path.name + KEPT_AS for part in parts)
    kept = f"; what it was made from is kept as {names}" if output is None else ""
    of = f" from {len(parts)} parts" if len(parts) > 1 else ""
    print(f"{made.file}: {made.messages} messages and {made.attachments} attachments recovered{of}{left}{kept}")
    return EXIT_OK
