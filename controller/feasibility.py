"""Can the rig follow this trajectory at all? Asked before a run, of the model and at its nominal parameters."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from softloop.controller.references import Plan
from softloop.dynamics.bending import pressure_for, rest_angle
from softloop.dynamics.parameters import MODEL_TYPE
from softloop.dynamics.pneumatics import pressure_rate
from softloop.wire.errors import BadConfig
from softloop.wire.kernel import array_of, kernel

_STEP_S = 0.01
_HEADROOM_KPA = 5.0  # below the supply: charging flow vanishes as the chamber nears it


@kernel(array_of(types.f8)(MODEL_TYPE, array_of(types.f8, 2)))
def _pressures(model: Any, points: np.ndarray) -> np.ndarray:
    """The pressure of Eq. 2 at each point (value, rate, acceleration, ...), (n,) kPa."""
    found = np.empty(points.shape[0])
    for k in range(found.size):
        found[k] = pressure_for(model.theta, points[k, 0], points[k, 1], points[k, 2])
    return found


@kernel(array_of(types.f8, 2)(MODEL_TYPE, array_of(types.f8)))
def _rate_limits(model: Any, pressures: np.ndarray) -> np.ndarray:
    """Slowest and fastest pressure rate under full current at each pressure, (n, 2) kPa/s."""
    found = np.empty((pressures.size, 2))
    for k in range(pressures.size):
        found[k, 0] = pressure_rate(model, model.theta, model.supply_kpa, pressures[k], 0.0, model.current_max_ma)
        found[k, 1] = pressure_rate(model, model.theta, model.supply_kpa, pressures[k], model.current_max_ma, 0.0)
    return found


def check_angle_plan(plan: Plan, model: Any) -> None:
    """Raise BadConfig where Eq. 2, solved for the pressure, asks for one or for a rate that the valves cannot give."""
    times = np.arange(0.0, plan.duration_s, _STEP_S)
    points = plan.sample(times)
    pressures = _pressures(model, points)
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
    rates, limits = np.gradient(pressures, _STEP_S), _rate_limits(model, np.ascontiguousarray(pressures))
    bad = ~((limits[:, 0] <= rates) & (rates <= limits[:, 1]))
    if bad.any():
        at = int(np.argmax(bad))
        raise BadConfig(
            f"the reference is not feasible: at {times[at]:.2f} s the pressure must change by {rates[at]:.0f} kPa/s at "
            f"{pressures[at]:.1f} kPa; full current gives {limits[at, 0]:.0f} to {limits[at, 1]:.0f} kPa/s"
        )
