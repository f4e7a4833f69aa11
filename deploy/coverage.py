"""`softloop coverage`: count over simulated rigs whether intervals hold what they say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from softloop.deploy.tally import count
from softloop.offline.identification.coverage import IdealTally, RigTally
from softloop.wire.errors import EXIT_OK


def coverage(layer: str, rigs: int, first_seed: int, output: Path | None, *, as_json: bool) -> int:
    """Count, show, and write what was counted as JSON. Raises BadFile, or Interrupted with what was counted shown."""
    tally = IdealTally() if layer == "ideal" else RigTally()
    seeds = range(first_seed, first_seed + rigs)
    says = {"layer": layer, "first_seed": first_seed, "asked_rigs": rigs}
    count(tally, seeds, "identifying rigs", says, output, _show, as_json=as_json)
    return EXIT_OK


def _show(counted: dict[str, Any]) -> None:
    ideal = counted["layer"] == "ideal"
    for method, rows in counted["methods"].items():
        table = Table(title=f"{method}, {counted['rigs']} rigs of the {counted['layer']} layer")
        for heading in _IDEAL if ideal else _RIG:
            table.add_column(heading, justify="right")
        for name, row in rows.items():
            table.add_row(name, *(_ideal_row(row) if ideal else _rig_row(row)))
        Console(highlight=False).print(table)


_IDEAL = ("parameter", "held, %", "its 95 % interval", "mean error, %", "half width, %")
_RIG = ("parameter", "mean held, %", "scatter held, %", "standard error, %", "scatter, %")


def _ideal_row(row: dict[str, float]) -> tuple[str, ...]:
    between = f"{100 * row['low']:.1f} to {100 * row['high']:.1f}"
    return f"{100 * row['held']:.1f}", between, f"{row['error_percent']:.3f}", f"{row['half_percent']:.3f}"


def _rig_row(row: dict[str, float]) -> tuple[str, ...]:
    held = f"{100 * row['mean_held']:.1f}", f"{100 * row['scatter_held']:.1f}"
    return *held, f"{row['error_percent']:.2f}", f"{row['spread_percent']:.2f}"
