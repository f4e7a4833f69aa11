"""`softloop log check` and `softloop log repair`: what was found, said to a person or as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from softloop.offline.log import find_log, open_log
from softloop.offline.log_check import LogCheck, check_log
from softloop.offline.log_repair import KEPT_AS, repair_log
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK

GAPS_SHOWN = 12


def check_run(run: Path, *, as_json: bool) -> int:
    """Say what a log holds and what is missing in it; EXIT_NEGATIVE when something is. Raises BadFile."""
    file = find_log(run)
    found = check_log(open_log(file))
    if as_json:
        print(json.dumps({"log": str(file), "whole": found.whole, "missing": found.missing, **asdict(found)}, indent=2))
    else:
        print("\n".join([f"{file}: {'whole' if found.whole else 'not whole'}", *_said(found)]))
    return EXIT_OK if found.whole else EXIT_NEGATIVE


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
        yield f"loss window: {found.ends_s:.3f} s to the end of the run; the recorder did not end this file"


def _who(sender: int) -> str:
    return f" of sender {sender}" if sender else ""


def repair_run(run: Path, output: Path | None) -> int:
    """Write a good file from a damaged log. Raises BadFile, Unavailable."""
    file = find_log(run)
    if output is None and not open_log(file).problems:
        print(f"{file}: nothing to repair")
        return EXIT_OK
    made = repair_log(file, output)
    left = f"; {made.left_out} damaged places left out" if made.left_out else ""
    kept = f"; the damaged file is kept as {file.name}{KEPT_AS}" if output is None else ""
    print(f"{made.file}: {made.messages} messages and {made.attachments} attachments recovered{left}{kept}")
    return EXIT_OK
