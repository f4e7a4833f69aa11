"""What `softloop identify` says beside its answer: one line each on standard error, so that the answer stays as it is."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from softloop.wire.errors import printable

SHOWN = 12  # lines of damage; a log that is damaged throughout has thousands


def say(text: str) -> None:
    """One line, whatever it quotes."""
    sys.stderr.write(f"softloop: {printable(text)}\n")


def say_faults(name: str, damage: Sequence[str], against: Sequence[str]) -> None:
    """What is wrong with the log of the run `name`, a line each, and why the run is no valid evidence, in one."""
    for text in damage[:SHOWN]:
        say(f"{name}: {text}")
    if len(damage) > SHOWN:
        say(f"{name}: and {len(damage) - SHOWN} more (all of them: softloop log check)")
    if against:
        say(f"{name}: not valid evidence: {'; '.join(against)}")
