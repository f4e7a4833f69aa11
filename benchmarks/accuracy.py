"""How exact is the plant's integration? Replays the valve currents of T2 runs, with their frames' ends, with different steps.

- ideal layer: against scipy's DOP853 (rtol 1e-10) on the controller's own equations, restarted at every change of the currents
  and wherever a valve meets a stop;
- rig layer, without noise: against itself at a twentieth of the step.

Replayed currents control nothing: an error that was made once is carried along, and on some rigs grows, because the block's
pressure pushes the charge valve open. The last column says by how much a small error at 0.5 s of the trajectory has grown at its
worst. The replay begins with the rig at rest, before the approach, and ends 60 s after the trajectory's start.

    python benchmarks/accuracy.py [RUN ...] [--closed-loop A:B] [--seconds 60]

Without a RUN (a run's directory, or its log) it makes four at wall pace first: the ideal layer, and the rig layer's seeds 1 to 3.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from logged_currents import Currents, apply, make_run, of_closed_loop, of_log
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from scipy.integrate import solve_ivp

from softloop.deploy.batch import seeds_of
from softloop.dynamics.bending import bending_acceleration
from softloop.dynamics.parameters import KV1_CHARGE, KV1_EXHAUST, KV6_CHARGE, KV6_EXHAUST, load_parameters, model_record, shipped
from softloop.dynamics.pneumatics import pressure_rate
from softloop.dynamics.valve import g3, g4
from softloop.offline.run_log import open_run
from softloop.plant.config import PlantConfig
from softloop.plant.physics import advance
from softloop.plant.records import ANGLE, CHAMBER, TUBE
from softloop.plant.setup import new_device, new_state, plant_record
from softloop.wire.errors import SoftloopError

SECONDS = 60.0
STEPS_US = (1000.0, 500.0, 400.0, 250.0, 100.0)
NUDGE_S, NUDGE_KPA = 0.5, 1e-5
RUNS = (("ideal", 1), ("rig", 1), ("rig", 2), ("rig", 3))
IDEAL_LIMITS = (1e-3, 1e-2)  # deg, kPa
RIG_LIMITS = (5e-3, 5e-2)


def replay(currents: Currents, step_ns: int, nudge_kpa: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Angle (deg) and chamber pressure (kPa) at each frame's end, before it takes effect; at `NUDGE_S` `nudge_kpa` is added."""
    params = plant_record(currents.plant)
    params.step_ns = step_ns
    state = new_state(params, new_device(currents.plant), 0)
    angle, pressure = np.zeros(len(currents.end_ns)), np.zeros(len(currents.end_ns))
    nudged = int(np.searchsorted(currents.end_ns, currents.from_ns + round(NUDGE_S * 1e9)))
    for n, end_ns in enumerate(currents.end_ns):
        advance(params, state, int(end_ns))
        if n == nudged:
            state.x[CHAMBER] += nudge_kpa
            state.x[TUBE] += nudge_kpa
        angle[n], pressure[n] = state.x[ANGLE], state.x[CHAMBER]
        apply(params, state, float(currents.charge_ma[n]), float(currents.exhaust_ma[n]))
    return angle, pressure


class Oracle:
    """The controller's own model under constant currents, by scipy."""

    def __init__(self) -> None:
        self.model = model_record(load_parameters(shipped()))
        self.charge_ma = 0.0
        self.exhaust_ma = 200.0

    def slope(self, _t: float, x: np.ndarray) -> tuple[float, float, float]:
        model = self.model
        rate = pressure_rate(model, model.theta, model.supply_kpa, x[2], self.charge_ma, self.exhaust_ma)
        return x[1], bending_acceleration(model.theta, x[0], x[1], x[2]), rate

    def areas(self, x: np.ndarray) -> tuple[float, float]:
        """Both valves' areas by Eq. 16 as if they had no stops, mm2."""
        model, supply, chamber = self.model, 1e3 * self.model.supply_kpa, 1e3 * x[2]
        theta = model.theta
        into = g3(model.charge, supply, chamber) * (theta[KV1_CHARGE] * self.charge_ma - theta[KV6_CHARGE])
        out = g3(model.exhaust, chamber, 0.0) * (theta[KV1_EXHAUST] * self.exhaust_ma - theta[KV6_EXHAUST])
        return 1e6 * (into + g4(model.charge, supply, chamber)), 1e6 * (out + g4(model.exhaust, chamber, 0.0))

    def _stops(self, x: np.ndarray) -> list[float]:
        """Change sign where a valve meets a stop, and where flow turns laminar."""
        full = 1e6 * self.model.charge.area_max_m2
        ratio = 101_325.0 / (101_325.0 + 1e3 * max(x[2], 0.0))
        return [*self.areas(x), *(area - full for area in self.areas(x)), ratio - 0.999]

    def advance(self, x: np.ndarray, span_s: float) -> np.ndarray:
        """`x` after `span_s`; restarted at each stop on the way."""
        left = span_s
        while left > 0.0:
            found = solve_ivp(self.slope, (0.0, left), x, method="DOP853", rtol=1e-10, atol=1e-11)
            end = found.y[:, -1]
            crossed = [i for i, (a, b) in enumerate(zip(self._stops(x), self._stops(end), strict=True)) if a * b < 0.0]
            if not crossed:
                return end
            x, gone = self._to_first(x, left, crossed)
            left -= gone
        return x

    def _to_first(self, x: np.ndarray, left: float, crossed: list[int]) -> tuple[np.ndarray, float]:
        def event(index: int) -> Any:
            def value(_t: float, at: np.ndarray) -> float:
                return self._stops(at)[index]

            value.terminal = True  # type: ignore[attr-defined]
            return value

        found = solve_ivp(self.slope, (0.0, left), x, method="DOP853", rtol=1e-10, atol=1e-11, events=[event(i) for i in crossed])
        gone = max(float(found.t[-1]), 1e-9)  # never stand still on the stop itself
        end = solve_ivp(self.slope, (0.0, gone), x, method="DOP853", rtol=1e-10, atol=1e-11)
        return end.y[:, -1], gone


def oracle_run(currents: Currents) -> tuple[np.ndarray, np.ndarray]:
    """What `replay` gives, by scipy."""
    oracle = Oracle()
    config = PlantConfig(layer="ideal")
    x = np.array(new_state(plant_record(config), new_device(config), 0).x[:3])
    angle, pressure, at_ns = np.zeros(len(currents.end_ns)), np.zeros(len(currents.end_ns)), 0
    for n, end_ns in enumerate(currents.end_ns):
        x = oracle.advance(x, 1e-9 * (int(end_ns) - at_ns))
        angle[n], pressure[n], at_ns = x[0], x[2], int(end_ns)
        oracle.charge_ma, oracle.exhaust_ma = float(currents.charge_ma[n]), float(currents.exhaust_ma[n])
    return angle, pressure


def errors(found: tuple[np.ndarray, np.ndarray], truth: tuple[np.ndarray, np.ndarray]) -> tuple[float, float]:
    """Largest differences of angle (deg) and pressure (kPa)."""
    return float(np.abs(found[0] - truth[0]).max()), float(np.abs(found[1] - truth[1]).max())


Errors = list[tuple[float, float, float]]  # step (us), angle (deg), pressure (kPa)


def ideal_errors(currents: Currents) -> Errors:
    """Each step against scipy."""
    truth = oracle_run(currents)
    return [(us, *errors(replay(currents, round(1e3 * us)), truth)) for us in STEPS_US]


def rig_errors(currents: Currents) -> Errors:
    """Each step against a twentieth of itself."""
    ns = [round(1e3 * us) for us in STEPS_US]
    return [(n / 1e3, *errors(replay(currents, n), replay(currents, n // 20))) for n in ns]


def growth(currents: Currents) -> float:
    """The largest error of the pressure that a unit of it at `NUDGE_S` leads to."""
    return errors(replay(currents, 500_000, NUDGE_KPA), replay(currents, 500_000))[1] / NUDGE_KPA


def judge(currents: Currents, table: Table) -> None:
    """Add the rows of one run's currents."""
    ideal = currents.plant.layer == "ideal"
    name, limits = ("ideal", IDEAL_LIMITS) if ideal else (f"rig, seed {currents.plant.seed}", RIG_LIMITS)
    grown = growth(currents)
    for step_us, angle, pressure in ideal_errors(currents) if ideal else rig_errors(currents):
        kept = "yes" if angle < limits[0] and pressure < limits[1] else "no"
        table.add_row(name, f"{step_us:g}", f"{angle:.1e}", f"{pressure:.1e}", kept, f"x{grown:.1f}", str(len(currents.end_ns)))
    table.add_section()


def measure(runs: list[Path], seeds: range, seconds: float, progress: Progress) -> Table:
    """The table of all runs and of the closed loop's currents on rigs of `seeds`; without either, four runs are made first."""
    limits = f"ideal {IDEAL_LIMITS[0]:g} deg, {IDEAL_LIMITS[1]:g} kPa; rig {RIG_LIMITS[0]:g} deg, {RIG_LIMITS[1]:g} kPa"
    table = Table(title=f"T2, {seconds:g} s; limits: {limits}", title_justify="left")
    for head in ("layer", "step us", "|dy| deg", "|dP| kPa", "kept", "errors grow", "frames"):
        table.add_column(head, justify="left" if head == "layer" else "right")
    with tempfile.TemporaryDirectory(prefix="sl-accuracy-") as folder:
        if not runs and not seeds:
            made = progress.track(RUNS, description="running T2 at wall pace")
            runs = [make_run(Path(folder), layer, seed) for layer, seed in made]
        for run in progress.track(runs, description="replaying"):
            judge(of_log(open_run(run), seconds), table)
        for seed in progress.track(seeds, description="closed loop"):
            currents = of_closed_loop("rig", seed)
            judge(currents.until(currents.from_ns * 1e-9 + seconds), table)
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", metavar="RUN", nargs="*", type=Path)
    parser.add_argument("--closed-loop", metavar="A:B", help="and of the closed loop, rigs A to B - 1")
    parser.add_argument("--seconds", type=float, default=SECONDS)
    options = parser.parse_args()
    try:
        seeds = seeds_of(options.closed_loop) if options.closed_loop else range(0)
        with Progress(console=Console(stderr=True), transient=True) as progress:
            table = measure(options.runs, seeds, options.seconds, progress)
    except SoftloopError as error:
        sys.stderr.write(f"accuracy: {error}\n")
        sys.exit(error.exit_code)
    Console(width=100).print(table)


if __name__ == "__main__":
    main()
