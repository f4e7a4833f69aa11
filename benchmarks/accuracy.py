"""How exact is the plant's integration? Replays one sequence of currents with different steps.

- ideal layer: against scipy's DOP853 (rtol 1e-10) on the controller's own equations, restarted at every change of the currents
  and wherever a valve meets a stop;
- rig layer, without noise: against itself at a twentieth of the step.

Replayed currents control nothing: an error that was made once is carried along, and on some rigs grows, because the block's
pressure pushes the charge valve open. The last column says by how much a small error at 0.5 s has grown at its worst.

    python benchmarks/accuracy.py [SECONDS]
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from crude_tracking import Currents, apply, track
from scipy.integrate import solve_ivp

from softloop.dynamics.bending import bending_acceleration
from softloop.dynamics.parameters import KV1_CHARGE, KV1_EXHAUST, KV6_CHARGE, KV6_EXHAUST, load_parameters, model_record, shipped
from softloop.dynamics.pneumatics import pressure_rate
from softloop.dynamics.valve import g3, g4
from softloop.plant.config import PlantConfig
from softloop.plant.physics import advance
from softloop.plant.records import ANGLE, CHAMBER, TUBE
from softloop.plant.setup import new_device, new_state, plant_record

SECONDS = 60.0
STEPS_US = (1000.0, 500.0, 250.0, 100.0)
NUDGED_FRAME, NUDGE_KPA = 100, 1e-5
IDEAL_LIMITS = (1e-3, 1e-2)  # deg, kPa
RIG_LIMITS = (5e-3, 5e-2)


def replay(layer: str, currents: Currents, step_ns: int, seed: int = 1, nudge_kpa: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Angle (deg) and chamber pressure (kPa) at each frame's end, before it takes effect; at 0.5 s `nudge_kpa` is added."""
    config = PlantConfig.model_validate({"layer": layer, "seed": seed})
    params = plant_record(config)
    params.step_ns = step_ns
    state = new_state(params, new_device(config), 0)
    angle, pressure = np.zeros(len(currents.end_ns)), np.zeros(len(currents.end_ns))
    for n, end_ns in enumerate(currents.end_ns):
        advance(params, state, int(end_ns))
        if n == NUDGED_FRAME:
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


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else SECONDS
    currents = track("ideal", seconds)
    truth = oracle_run(currents)
    print(f"{seconds:g} s; angle {truth[0].min():.1f} to {truth[0].max():.1f} deg")
    print(f"ideal layer against scipy; wanted: under {IDEAL_LIMITS[0]:g} deg, {IDEAL_LIMITS[1]:g} kPa")
    for step_us in STEPS_US:
        angle, pressure = errors(replay("ideal", currents, round(1e3 * step_us)), truth)
        print(f"  step {step_us:6.0f} us   {angle:9.2e} deg   {pressure:9.2e} kPa")
    print(f"rig layer against a twentieth of the step; wanted: under {RIG_LIMITS[0]:g} deg, {RIG_LIMITS[1]:g} kPa")
    for seed in (1, 2, 3):
        currents = track("rig", seconds, seed)
        nudged = replay("rig", currents, 500_000, seed, NUDGE_KPA), replay("rig", currents, 500_000, seed)
        growth = errors(*nudged)[1] / NUDGE_KPA
        for step_us in STEPS_US:
            step_ns = round(1e3 * step_us)
            truth = replay("rig", currents, step_ns // 20, seed)
            angle, pressure = errors(replay("rig", currents, step_ns, seed), truth)
            print(f"  seed {seed}  step {step_us:6.0f} us   {angle:9.2e} deg   {pressure:9.2e} kPa   errors grow x{growth:.0f}")


if __name__ == "__main__":
    main()
