"""`softloop experiment pressure`: the pressure law on the two multi-sines, from which the actuator is identified."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from softloop.controller.config import ControllerConfig
from softloop.controller.references import EXCITATION_SPAN_KPA
from softloop.deploy.experiment import Asked, Place, begin, gains_of, run_all
from softloop.deploy.progress import counted_progress
from softloop.deploy.tune import seeds_of
from softloop.offline.closed_loop import simulate_run
from softloop.offline.excitation import BAR_KPA, PressureTracking, pressure_tracking, run_tracking
from softloop.offline.run_log import open_run
from softloop.offline.tuning import EXCITATION_APPROACH_S
from softloop.plant.config import PlantConfig
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK, BadConfig

# Name of the run's directory -> what the paper calls it, and its band.
RUNS = {"excitation_1hz": "Data1 and Data2, [0, 1] Hz", "excitation_05hz": "Data3, [0, 0.5] Hz"}
RESULT, FIGURE = "pressure.json", "fig2ab.png"
ENVELOPE_KPA = 10.0  # the multi-sine stays this far below the gate's limit


def run_pressure(asked: Asked, law: str) -> int:
    """Excite, judge, draw; EXIT_NEGATIVE where the pressure was off by more than BAR_KPA. Raises as `softloop run` does."""
    place = begin(asked, "pressure")
    check_envelope(place)
    code = run_all(place, {name: {"controller": controller_of(law, name, place.bench.controller)} for name in RUNS})
    if code != EXIT_OK:
        return code
    found = judge(place.folder)
    if not asked.quiet:
        show(place, found)
    return EXIT_OK if all(run.kept for run in found.values()) else EXIT_NEGATIVE


def controller_of(law: str, trajectory: str, own: ControllerConfig | None) -> dict[str, Any]:
    """The [controller] table of an excitation: the law with its tuned gains where it has some."""
    return {**gains_of(law, own), "law": law, "trajectory": trajectory, "approach_s": EXCITATION_APPROACH_S}


def check_envelope(place: Place) -> None:
    """The excitation must fit into the gate's envelope. Raises BadConfig."""
    limit = place.bench.valves.pressure_max_kpa if place.bench.valves else 0.0
    if EXCITATION_SPAN_KPA[1] + ENVELOPE_KPA > limit:
        raise BadConfig(
            f"{place.asked.bench}: key 'valves.pressure_max_kpa': {limit:g} kPa leaves no room for an excitation up to "
            f"{EXCITATION_SPAN_KPA[1]:g} kPa; at least {EXCITATION_SPAN_KPA[1] + ENVELOPE_KPA:g} kPa is needed"
        )


def judge(folder: Path) -> dict[str, PressureTracking]:
    """Each run's tracking; leaves RESULT and FIGURE in `folder`. Raises BadFile."""
    found = {name: pressure_tracking(open_run(folder / name)) for name in RUNS}
    content = {name: figures_of(run) | {"log": str(folder / name)} for name, run in found.items()}
    (folder / RESULT).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    from softloop.offline.excitation_figure import figure_2ab  # noqa: PLC0415 - matplotlib only where it draws

    figure_2ab({RUNS[name]: run for name, run in found.items()}).savefig(folder / FIGURE)
    return found


def figures_of(run: PressureTracking) -> dict[str, Any]:
    """What programs read."""
    return {"max_kpa": run.max_kpa, "rms_kpa": run.rms_kpa, "worst_s": run.worst_s, "truth_max_kpa": run.truth_max_kpa}


def show(place: Place, found: dict[str, PressureTracking]) -> None:
    """The table, and what to do next."""
    console = Console(highlight=False)
    table = Table(title=f"pressure less desired, as measured; bar {BAR_KPA:g} kPa", title_justify="left")
    for heading in ("run", "largest, kPa", "at, s", "RMS, kPa", "true pressure, largest, kPa"):
        table.add_column(heading, justify="left" if heading == "run" else "right")
    for name, run in found.items():
        truth = f"{run.truth_max_kpa:.2f}" if run.truth_max_kpa is not None else "-"
        table.add_row(RUNS[name], f"{run.max_kpa:.2f}", f"{run.worst_s:.1f}", f"{run.rms_kpa:.2f}", truth)
    console.print(table)
    runs = " ".join(str(place.run_dir(name)) for name in RUNS)
    console.print(f"figure: {place.folder / FIGURE}\nidentify: softloop identify {runs}", soft_wrap=True)


def run_over_rigs(law: str, seeds: str, plant: PlantConfig, *, as_json: bool) -> int:
    """The two runs on every rig of `seeds`, in this process and without logs; EXIT_NEGATIVE where one is off by over BAR_KPA.

    Raises BadConfig.
    """
    rigs = seeds_of(seeds)
    with counted_progress("exciting rigs", quiet=as_json) as progress:
        found = over_rigs(law, rigs, plant, progress)
    if as_json:
        print(json.dumps({"law": law, "seeds": seeds, "runs": found}, indent=2))
    else:
        show_rigs(law, seeds, found)
    return EXIT_OK if all(kept(errors) == len(rigs) for errors in found.values()) else EXIT_NEGATIVE


def over_rigs(law: str, seeds: Sequence[int], plant: PlantConfig, progress: Callable[[int, int], None]) -> dict[str, list[float]]:
    """Name of the run -> largest error on each rig, kPa; inf where the gate broke it off."""
    found: dict[str, list[float]] = {name: [] for name in RUNS}
    for done, seed in enumerate(seeds):
        progress(done, len(seeds))
        for name, errors in found.items():
            controller = ControllerConfig.model_validate(controller_of(law, name, None))
            run = simulate_run(controller, plant.model_copy(update={"seed": seed}))
            errors.append(run_tracking(run, controller.actuation_delay_ms).max_kpa if run.completed else inf)
    progress(len(seeds), len(seeds))
    return found


def kept(errors: Sequence[float]) -> int:
    """On how many rigs the bar was kept."""
    return sum(error <= BAR_KPA for error in errors)


def show_rigs(law: str, seeds: str, found: dict[str, list[float]]) -> None:
    """Median and worst of each run."""
    table = Table(title=f"{law}, rigs {seeds}: largest error of a run, as measured, kPa", title_justify="left")
    for heading in ("run", "median", "worst", "of rig", f"within {BAR_KPA:g} kPa"):
        table.add_column(heading, justify="left" if heading == "run" else "right")
    for name, errors in found.items():
        worst = int(np.argmax(errors))
        cells = (
            f"{np.median(errors):.2f}",
            f"{errors[worst]:.2f}",
            str(seeds_of(seeds)[worst]),
            f"{kept(errors)} of {len(errors)}",
        )
        table.add_row(RUNS[name], *cells)
    Console(highlight=False).print(table)
