"""`softloop fits`: identify rigs from their own excitation, and show how well the models simulate what they have not seen."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from softloop.deploy.tally import count
from softloop.deploy.tune import seeds_of
from softloop.offline.identification.structure import Structure
from softloop.offline.reproduction import MEMORY, FitTally, words_of
from softloop.wire.errors import EXIT_OK


def fits(seeds: str, hysteresis: int | None, creep: int | None, output: Path | None, *, as_json: bool) -> int:
    """Fit, show, and write as JSON. Raises BadConfig, BadFile, or Interrupted with what was found shown."""
    rigs = seeds_of(seeds)
    memory = replace(
        MEMORY,
        hysteresis=MEMORY.hysteresis if hysteresis is None else hysteresis,
        creep=MEMORY.creep if creep is None else creep,
    )
    says = {"seeds": seeds, "hysteresis": memory.hysteresis, "creep": memory.creep}
    count(FitTally(memory), rigs, "fitting rigs", says, output, lambda answer: _show(answer, memory), as_json=as_json)
    return EXIT_OK


def _show(answer: dict[str, Any], memory: Structure) -> None:
    table = Table(title=f"NRMSE fit of a free simulation, %, over {answer['rigs']} rigs; trained on Data1")
    for heading in ("model", "data", "median", "worst", "of rig"):
        table.add_column(heading, justify="right")
    for key, words in (("oe", "Eq. 2"), ("memory", f"Eq. 2 with {words_of(memory)}")):
        for data, over in answer["models"][key].items():
            table.add_row(words, data, f"{over['median']:.2f}", f"{over['worst']:.2f}", str(over["worst_seed"]))
    Console(highlight=False).print(table)
