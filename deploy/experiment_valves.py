"""`softloop experiment valves`: flow tests of both valves on a calibration tank, at several supply pressures, as for Fig. 4.

A real supply's regulator is set by hand: the command says to what, and waits. A simulated one is set in its bench file.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from softloop.deploy.bench import Bench
from softloop.deploy.config import CalibrationConfig
from softloop.deploy.destination import check_destination
from softloop.deploy.experiment import Asked, Place, begin, check_free, run_one
from softloop.deploy.valve_parameters import RUN_PREFIX, TankRuns, check_identities, write_valves
from softloop.dynamics.parameters import Parameters
from softloop.offline.identification.intervals import Uncertainty
from softloop.offline.identification.tank_tests import (
    LEAST_KPA,
    VALVES,
    Volume,
    Windows,
    fit_on_tank,
    fit_ratios,
    flow_tests,
    joined,
)
from softloop.offline.identification.valve_flow import NAMES, FlowTests, ValveFit
from softloop.offline.run_log import open_run
from softloop.plant.config import SUPPLY_KPA
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK, BadConfig

SUPPLIES_KPA = (150.0, 175.0, 200.0)
LEAST_SUPPLIES = 3
RESULT, FIGURE = "valves.json", "fig4.png"
ZERO_C_K = 273.15
ENVELOPE_KPA = 10.0
# On the actuator itself, of some ten times less volume than a tank: lower currents, shorter tests and windows.
SMALL = {"first_ma": 62.0, "last_ma": 110.0, "test_s": 2.0, "fill_s": 2.0, "empty_s": 3.0, "top_kpa": 110.0}
SMALL_WINDOWS = Windows(settle_s=0.05, window_s=0.05)


@dataclass(frozen=True)
class Found:
    """What the tests of one valve came to."""

    sure: Uncertainty | None
    rank: int
    of: int
    fit: float
    hidden: tuple[str, ...]


def run_valves(asked: Asked, supplies_kpa: tuple[float, ...], *, ratios: bool, output: Path | None = None) -> int:
    """Test, fit, show; EXIT_NEGATIVE where a valve's tests show none of its numbers. Raises as `softloop run` does.

    Args:
        supplies_kpa: gauge; three or more, from different runs of the regulator.
        ratios: on the actuator itself, whose volume is not known: ratios to it.
        output: where a parameter file with the valves as measured goes; only from a tank.
    """
    if ratios and output is not None:
        raise BadConfig(
            "--output: a parameter file needs areas, and --ratios gives only ratios to an unknown volume; leave one out"
        )
    place = begin(asked, "valves")
    check(place, supplies_kpa, ratios=ratios)
    if output is not None:
        check_output(place, output)
    check_free(place, map(run_name, supplies_kpa))
    for supply in supplies_kpa:
        set_supply(place, supply)
        code = run_one(place, run_name(supply), changes(place, supply, ratios=ratios))
        if code != EXIT_OK:
            return code
    found, on_tank = judge(place, supplies_kpa, ratios=ratios)
    if not asked.quiet:
        show(place, found, ratios=ratios)
    if output is not None and on_tank is not None:
        write_valves(output, on_tank)
        if not asked.quiet:
            Console(highlight=False).print(f"parameters: {output}", soft_wrap=True)
    return EXIT_OK if all(f.sure is not None for f in found.values()) else EXIT_NEGATIVE


def check(place: Place, supplies_kpa: tuple[float, ...], *, ratios: bool) -> None:
    """Refuse what cannot be measured or would leave the envelope, before anything moves. Raises BadConfig."""
    bench, file = place.bench, place.asked.bench
    if bench.calibration is None and not ratios:
        raise BadConfig(
            f"{file}: flow tests of the valves need a known volume on the port, and there is no table [calibration] that "
            "declares a tank (tank_ml); with --ratios the rig's own pressure gives ratios to its volume"
        )
    check_supplies(place, supplies_kpa)
    limit = bench.valves.pressure_max_kpa if bench.valves else 0.0
    top = SMALL["top_kpa"] if ratios else bench.controller.valve_test.top_kpa if bench.controller else 0.0
    if top + ENVELOPE_KPA > limit:
        raise BadConfig(f"{file}: key 'controller.valve_test.top_kpa': must be at least {ENVELOPE_KPA:g} kPa below "
                        f"valves.pressure_max_kpa ({limit:g}), got {top:g}")  # fmt: skip
    if bench.plant is None and not sys.stdin.isatty():
        raise BadConfig("experiment valves: somebody at a terminal has to set the supply's regulator between the runs")


def check_output(place: Place, output: Path) -> None:
    """The file can be written, and the parameters beside the valves are this rig's. Raises BadFile or BadConfig."""
    check_destination(output, "--output")
    evidence, run = parameters_of(place).evidence, place.bench.run
    if evidence is not None and place.bench.controller is not None:
        check_identities(evidence.rig, run.rig or place.bench.name, place.bench.controller.parameters)


def check_supplies(place: Place, supplies_kpa: tuple[float, ...]) -> None:
    """Enough different pressures, each one that the supply can be set to and its sensor can read. Raises BadConfig."""
    different = {run_name(supply) for supply in supplies_kpa}
    if len(different) < LEAST_SUPPLIES:
        raise BadConfig(f"--supply: {LEAST_SUPPLIES} different pressures or more are needed, got {len(different)}")
    if len(different) < len(supplies_kpa):
        raise BadConfig("--supply: a pressure is there twice; give each once")
    most, why = _highest(place.bench)
    for supply in supplies_kpa:
        if not LEAST_KPA < supply <= most:  # not true of a NaN either
            raise BadConfig(f"--supply: {supply:g} kPa: must be above {LEAST_KPA:g}, or too little lies across a valve, "
                            f"and at most {most:g}, {why}")  # fmt: skip


def _highest(bench: Bench) -> tuple[float, str]:
    """The highest supply pressure, kPa, and what makes it so."""
    bounds = [(bench.pressures.supply.span_kpa, "pressures.supply.span_kpa of its sensor")] if bench.pressures else []
    if bench.plant is not None:
        bounds.append((SUPPLY_KPA[1], "the limit of plant.supply_kpa"))
    return min(bounds, default=(inf, "no limit"))


def run_name(supply_kpa: float) -> str:
    return f"{RUN_PREFIX}{supply_kpa:g}"


def set_supply(place: Place, supply_kpa: float) -> None:
    """Ask a person to set the regulator of a real supply."""
    if place.bench.plant is None:
        sys.stderr.write(f"Set the supply to {supply_kpa:g} kPa (gauge) and press Enter: ")
        sys.stderr.flush()
        sys.stdin.readline()


def changes(place: Place, supply_kpa: float, *, ratios: bool) -> dict[str, Any]:
    """The tables of one run that differ from the bench's."""
    controller: dict[str, Any] = {"law": "valve_test", "trajectory": "valve_steps"}
    if ratios:
        controller["valve_test"] = SMALL
    return {"controller": controller} | ({"plant": {"supply_kpa": supply_kpa}} if place.bench.plant is not None else {})


def judge(place: Place, supplies_kpa: tuple[float, ...], *, ratios: bool) -> tuple[dict[str, Found], TankRuns | None]:
    """What all runs together say of each valve; leaves RESULT, and the figure where there is a tank. Raises BadFile."""
    parameters = parameters_of(place)
    discharge, volume = parameters.pneumatics.discharge, volume_of(place.bench.calibration, parameters, ratios=ratios)
    logs = [open_run(place.run_dir(run_name(s))) for s in supplies_kpa]
    parts = [flow_tests(log, volume, SMALL_WINDOWS if ratios else Windows()) for log in logs]
    tests = {valve: joined([p[valve] for p in parts]) for valve in VALVES}
    on_tank = None
    if ratios:
        found = {valve: _of_ratios(tests[valve], volume, discharge) for valve in VALVES}
    else:
        fits = {valve: fit_on_tank(tests[valve], volume, discharge) for valve in VALVES}
        found = {valve: _of_fit(fit) for valve, fit in fits.items()}
        on_tank = TankRuns(logs, parts, fits, volume, discharge)
        _draw(place.folder, tests, fits, discharge, volume.temperature_k)
    content = {v: as_dict(f) | {"tests": len(tests[v].flow_kg_s), "logs": [str(x.path) for x in logs]} for v, f in found.items()}
    (place.folder / RESULT).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return found, on_tank


def parameters_of(place: Place) -> Parameters:
    """The controller's parameters: C_f, and the nominal volume."""
    from softloop.controller.setup import parameters_of as of_controller  # noqa: PLC0415 - it brings the kernels

    assert place.bench.controller is not None
    return of_controller(place.bench.controller)


def volume_of(calibration: CalibrationConfig | None, parameters: Parameters, *, ratios: bool) -> Volume:
    """The tank, or for ratios the nominal volume, which cancels."""
    if calibration is None or ratios:
        return Volume(parameters.pneumatics.volume_m3, 0.0, parameters.pneumatics.temperature_k)
    return Volume(1e-6 * calibration.tank_ml, 0.01 * calibration.tank_error_percent, calibration.temperature_c + ZERO_C_K)


def _of_fit(fit: ValveFit) -> Found:
    return Found(fit.uncertainty, fit.rank, len(NAMES), fit.fit, tuple(n for n in NAMES if n not in fit.shown))


def _of_ratios(tests: FlowTests, volume: Volume, discharge: float) -> Found:
    found = fit_ratios(tests, volume, discharge)
    shown = {n.removesuffix(" / V") for n in found.names}
    return Found(found.sure, found.rank, len(NAMES) + 1, found.fit, ("V", *(n for n in NAMES if n not in shown)))


def as_dict(found: Found) -> dict[str, Any]:
    """What programs read; what is not identifiable has no number."""
    rows: dict[str, dict[str, float]] = {}
    if found.sure is not None:
        ends = found.sure.interval()
        rows = {
            n: {"value": v, "low": a, "high": b} for n, v, a, b in zip(found.sure.names, found.sure.values, *ends, strict=True)
        }
    return {"numbers": rows, "not_identifiable": found.hidden, "rank": found.rank, "of": found.of, "fit_percent": found.fit}


def _draw(folder: Path, tests: dict[str, FlowTests], fits: dict[str, ValveFit], discharge: float, temperature_k: float) -> None:
    from softloop.offline.identification.flow_figure import figure_4  # noqa: PLC0415 - matplotlib only where it draws
    from softloop.offline.vector import save  # noqa: PLC0415 - likewise

    drawn = figure_4(tests, fits, discharge, temperature_k)
    for ending in ("png", "svg"):
        save(drawn, (folder / FIGURE).with_suffix(f".{ending}"))


def show(place: Place, found: dict[str, Found], *, ratios: bool) -> None:
    """One table for each valve, and what its tests do not show."""
    console = Console(highlight=False)
    for valve, one in found.items():
        table = Table(
            title=f"{valve} valve: flow fits {one.fit:.2f} % (NRMSE); rank {one.rank} of {one.of}", title_justify="left"
        )
        for heading in ("number", "value", "95 % interval"):
            table.add_column(heading, justify="left" if heading == "number" else "right")
        for name, row in as_dict(one)["numbers"].items():
            table.add_row(name, f"{row['value']:.4g}", f"{row['low']:.4g} to {row['high']:.4g}")
        console.print(table)
        if one.hidden:
            console.print(f"not identifiable from these tests, so no number is given: {', '.join(one.hidden)}")
    where = place.folder / (RESULT if ratios else FIGURE)
    console.print(f"{'result' if ratios else 'figure'}: {where}", soft_wrap=True)
