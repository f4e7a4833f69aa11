"""One line of `softloop doctor`: what was looked at, the verdict, what was found, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

Verdict = Literal["pass", "warn", "fail"]
_ORDER: tuple[Verdict, ...] = ("pass", "warn", "fail")


@dataclass(frozen=True)
class Check:
    """What one look at the machine or a device brought.

    Attributes:
        name: what was looked at.
        verdict: pass; warn: the rig runs, and something will go wrong under load or later; fail: do not run it so.
        found: in words, with the numbers that led to the verdict.
        do: what a person can do; empty at a pass.
        measured: the numbers, for programs.
    """

    name: str
    verdict: Verdict
    found: str
    do: str = ""
    measured: dict[str, Any] = field(default_factory=dict)


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """The worst of some verdicts; pass when there is none."""
    return max(verdicts, key=_ORDER.index, default="pass")


def judged(value: float, warn_above: float, fail_above: float) -> Verdict:
    """The verdict on a number that should be small."""
    if value > fail_above:
        return "fail"
    return "warn" if value > warn_above else "pass"
