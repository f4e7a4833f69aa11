"""Can the rig follow this trajectory at all? Asked before a run, of the model and at its nominal parameters."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softloop.controller.references import Plan
from softloop.dynamics.bending import pressure_for, rest_angle
from softloop.dynamics.pneumatics import pressure_rate
from softloop.wire.errors import BadConfig

_STEP_S = 0.01
_HEADROOM_KPA = 5.0  # below the supply: charging flow vanishes as the chamber nears it


def check_angle_plan(plan: Plan, model: Any) -> None:
    """Raise BadConfig where Eq. 2, solved for the pressure, asks for one or for a rate that the valves cannot give."""
    times = np.arange(0.0, plan.duration_s, _STEP_S)
    points = plan.sample(times)
    pressures = np.array([pressure_for(model.theta, p[0], p[1], p[2]) for p in points])
    lowest = int(np.argmin(pressures))
    if pressures[lowest] < 0.0:
        rest = rest_angle(model.theta)
        raise BadConfig(
            f"the reference is not feasible: at {times[lowest]:.2f} s ({points[lowest, 0]:.1f} deg) it needs "
            f"{pressures[lowest]:.1f} kPa; without pressure the actuator rests at {rest:.2f} deg"
        )
    check_pressure_series(times, pressures, model)


def check_pressure_plan(plan: Plan, model: Any) -> None:
    """The same for a trajectory that is a pressure."""
    times = np.arange(0.0, plan.duration_s, _STEP_S)
    check_pressure_series(times, plan.sample(times)[:, 0], model)


def check_pressure_series(times: NDArray[np.float64], pressures: NDArray[np.float64], model: Any) -> None:
    """Raise BadConfig where a pressure lies outside what the supply gives, or moves faster than full current moves it."""
    ceiling = model.supply_kpa - _HEADROOM_KPA
    worst = int(np.argmax(np.abs(pressures - ceiling / 2)))
    if not 0.0 <= pressures[worst] <= ceiling:
        raise BadConfig(
            f"the reference is not feasible: at {times[worst]:.2f} s it needs {pressures[worst]:.1f} kPa; "
            f"the supply of {model.supply_kpa:.0f} kPa allows 0 to {ceiling:.0f} kPa"
        )
    full = model.current_max_ma
    for time, pressure, rate in zip(times, pressures, np.gradient(pressures, _STEP_S), strict=True):
        fastest = pressure_rate(model, model.theta, model.supply_kpa, pressure, full, 0.0)
        slowest = pressure_rate(model, model.theta, model.supply_kpa, pressure, 0.0, full)
        if not slowest <= rate <= fastest:
            raise BadConfig(
                f"the reference is not feasible: at {time:.2f} s the pressure must change by {rate:.0f} kPa/s at "
                f"{pressure:.1f} kPa; full current gives {slowest:.0f} to {fastest:.0f} kPa/s"
            )
