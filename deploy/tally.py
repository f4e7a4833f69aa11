"""Long counts over rigs that keep what they have: written as they go, and shown up to where somebody interrupted them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from softloop.deploy.progress import counted_progress
from softloop.wire.errors import BadFile, Interrupted


class Tally(Protocol):
    """What counts over rigs. `steps`: of work in a rig; `block`: rigs after which it is kept; `rigs`: done so far."""

    @property
    def steps(self) -> int: ...
    @property
    def block(self) -> int: ...
    @property
    def rigs(self) -> int: ...
    def add(self, seed: int, step: Callable[[int], None]) -> None: ...
    def counted(self) -> dict[str, Any]: ...


def count(
    tally: Tally,
    seeds: Sequence[int],
    what: str,
    says: dict[str, Any],
    output: Path | None,
    show: Callable[[dict[str, Any]], None],
    *,
    as_json: bool,
) -> None:
    """Add each seed to `tally`, and show what was counted: all, or what there is when it is interrupted.

    Args:
        tally: counts.
        seeds: the rigs.
        what: for the bar.
        says: what stands first in the answer.
        output: where the answer is kept as JSON, whole after every block of rigs; None: nowhere.
        show: prints an answer as tables.
        as_json: print it as JSON instead.

    Raises:
        BadFile: `output` cannot be written.
        Interrupted: with how many rigs were counted, after these have been shown.
    """
    if output and not output.parent.is_dir():
        raise BadFile(f"{output}: there is no folder {output.parent}")
    with suppress(KeyboardInterrupt), counted_progress(what, quiet=as_json) as progress:
        go_over(tally, seeds, progress, lambda: _kept(output, says | tally.counted()))
    if tally.rigs:
        answer = _kept(output, says | tally.counted())
        if as_json:
            print(json.dumps(answer, indent=2))
        else:
            show(answer)
    if tally.rigs < len(seeds):
        shown = "which is what was shown" if tally.rigs else "so that there is nothing to show"
        raise Interrupted(f"interrupted after {tally.rigs} of {len(seeds)} rigs, {shown}")


def go_over(tally: Tally, seeds: Sequence[int], progress: Callable[[int, int], None], keep: Callable[[], Any] = bool) -> None:
    """Add each seed to `tally`; `progress(done, total)` in its steps, `keep()` after each of its blocks."""
    total = len(seeds) * tally.steps
    for index, seed in enumerate(seeds):
        tally.add(seed, _from(index * tally.steps, total, progress))
        if tally.rigs % tally.block == 0:
            keep()
    progress(total, total)


def _from(first: int, total: int, progress: Callable[[int, int], None]) -> Callable[[int], None]:
    return lambda part: progress(first + part, total)


def _kept(output: Path | None, answer: dict[str, Any]) -> dict[str, Any]:
    """`answer`, written; the file is whole at every moment."""
    if output is None:
        return answer
    part = output.with_name(f"{output.name}.part")
    try:
        part.write_text(json.dumps(answer, indent=2) + "\n", encoding="utf-8")
        part.replace(output)
    except OSError as error:
        raise BadFile(f"{output}: cannot be written: {error.strerror or error}") from None
    return answer
