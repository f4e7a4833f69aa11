"""`softloop experiment tracking`: every law on T1 and T2, as in the paper's Figs. 6 and 7."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from softloop.controller.config import ControllerConfig
from softloop.controller.records import ANGLE_LAWS
from softloop.deploy.experiment import Asked, Place, begin, gains_of, run_all
from softloop.offline.run_log import open_run
from softloop.offline.summary import PAPER_T1, PAPER_T2, shown, summarise
from softloop.wire.errors import EXIT_OK, BadConfig

TRAJECTORIES = ("t1", "t2")
DEFAULT_LAWS = ("pid", "smc", "arc", "arc_eso")
RESULT = "tracking.json"
ERRORS = ("max_deg", "steady_deg", "rms_deg")
# Law -> what the paper measured on its rig: T1's largest and steady error, T2's largest.
PAPER = {
    "smc": (*PAPER_T1["SMC (C2)"], PAPER_T2["SMC (C2)"][0]),
    "arc": (*PAPER_T1["ARC (C3)"], PAPER_T2["ARC (C3)"][0]),
}


def run_tracking(asked: Asked, laws: Sequence[str], *, own_gains: bool) -> int:
    """Run every law on both trajectories, and show how they did; the first exit code that is not EXIT_OK.

    Args:
        laws: of the controller, that follow an angle.
        own_gains: with the bench's gains instead of each law's tuned ones.

    Raises:
        BadConfig: no such law. Otherwise as `softloop run`.
    """
    check_laws(laws)
    place = begin(asked, "tracking")
    names = {f"{law}_{trajectory}": (law, trajectory) for law in laws for trajectory in TRAJECTORIES}
    runs = {
        name: {"controller": controller_of(*pair, place.bench.controller, own_gains=own_gains)} for name, pair in names.items()
    }
    code = run_all(place, runs)
    if code != EXIT_OK:
        return code
    found = judge(place, names)
    if not asked.quiet:
        show(place, found)
    return EXIT_OK


def check_laws(laws: Sequence[str]) -> None:
    """Raises BadConfig when one does not follow an angle, or there is none."""
    if not laws or not set(laws) <= set(ANGLE_LAWS):
        raise BadConfig(f"--laws '{','.join(laws)}': tracking is for {', '.join(ANGLE_LAWS)}")


def controller_of(law: str, trajectory: str, own: ControllerConfig | None, *, own_gains: bool) -> dict[str, Any]:
    """The [controller] table of a run."""
    gains = {} if own_gains else gains_of(law, own)
    return {**gains, "law": law, "trajectory": trajectory}


def judge(place: Place, names: dict[str, tuple[str, str]]) -> dict[str, dict[str, Any]]:
    """Errors of every run, against the true angle where there is a plant; leaves RESULT in the folder. Raises BadFile."""
    found = {}
    for name, (law, trajectory) in names.items():
        log = open_run(place.run_dir(name))
        summary = summarise(log)
        against = "truth" if summary["truth_error_max_deg"] is not None else "sensor"
        errors = {key: summary[f"{against}_error_{key}"] for key in ERRORS}
        found[name] = {"law": law, "trajectory": trajectory, "against": against, **errors, "log": str(log.path)}
    (place.folder / RESULT).write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    return found


def paper_of(law: str, trajectory: str) -> tuple[float | None, float | None]:
    """What the paper measured of a law on a trajectory: largest and steady error, deg; None where it says nothing."""
    printed = PAPER.get(law)
    if printed is None:
        return None, None
    return (printed[0], printed[1]) if trajectory == "t1" else (printed[2], None)


def show(place: Place, found: dict[str, dict[str, Any]]) -> None:
    """One row for each run."""
    table = Table(title="error, angle less reference, deg", title_justify="left")
    for heading in ("law", "on", "largest", "paper", "steady", "paper", "RMS", "against"):
        table.add_column(heading, justify="left" if heading in ("law", "on", "against") else "right")
    for row in found.values():
        largest, steady = paper_of(row["law"], row["trajectory"])
        cells = [shown(row["max_deg"]), shown(largest), shown(row["steady_deg"]), shown(steady), shown(row["rms_deg"], 3)]
        table.add_row(row["law"], row["trajectory"], *cells, "true angle" if row["against"] == "truth" else "inclinometer")
    console = Console(highlight=False)
    console.print(table)
    console.print(f"runs: {place.folder}", soft_wrap=True)
