"""The gate's limits beside what the controller will ask for: said before anything moves, and not by a FAULT amid it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from softloop.deploy.bench import Bench
from softloop.wire.errors import BadConfig

if TYPE_CHECKING:
    from softloop.controller.setup import Controller

_STEP_S = 0.01
VENT_PART = 0.5  # of the flow at full current: then a chamber is empty within twice its shortest time


def check_envelope(bench: Bench, controller: Controller) -> None:
    """The largest current and the trajectory lie within the gate's limits. Raises BadConfig."""
    if bench.valves is None or bench.controller is None:
        return
    _check_current(bench, controller)
    _check_vent(bench, controller)
    law = bench.controller.law
    if law == "valve_test":
        return
    values = controller.plan.sample(np.arange(0.0, controller.plan.duration_s, _STEP_S))[:, 0]
    gate, lowest, highest = bench.valves, float(values.min()), float(values.max())
    if law in ("pressure", "pressure_eso"):
        beyond = [("pressure_max_kpa", highest, gate.pressure_max_kpa, "kPa", highest > gate.pressure_max_kpa)]
    else:
        beyond = [
            ("angle_max_deg", highest, gate.angle_max_deg, "deg", highest > gate.angle_max_deg),
            ("angle_min_deg", lowest, gate.angle_min_deg, "deg", lowest < gate.angle_min_deg),
        ]
    for key, reached, limit, unit, is_beyond in beyond:
        if is_beyond:
            raise BadConfig(
                f"key 'valves.{key}': the trajectory '{bench.controller.trajectory}' goes to {reached:.1f} {unit} and "
                f"the gate faults beyond {limit:g}; choose another trajectory or another limit"
            )


def _check_current(bench: Bench, controller: Controller) -> None:
    assert bench.valves is not None
    assert bench.controller is not None
    allowed_ma, model_ma = bench.valves.current_max_ma, float(controller.model[0]["current_max_ma"])
    if model_ma > allowed_ma:
        raise BadConfig(
            f"key 'valves.current_max_ma': the gate faults above {allowed_ma:g} mA, the controller saturates at {model_ma:g}, "
            f"[pneumatics] current_max_ma of its parameters '{bench.controller.parameters}'; make them agree"
        )


def _check_vent(bench: Bench, controller: Controller) -> None:
    """Venting empties the chamber: by the model the exhaust valve opens far enough, also where pressure holds it shut."""
    from softloop.dynamics.pneumatics import pressure_rate  # noqa: PLC0415 - it brings numba: only where it is needed

    assert bench.valves is not None
    assert bench.controller is not None
    gate, model = bench.valves, controller.model[0]
    for pressure_kpa in (gate.vent_again_kpa, gate.pressure_max_kpa):
        shut, vent, full = (
            pressure_rate(model, model.theta, model.supply_kpa, pressure_kpa, 0.0, exhaust_ma)
            for exhaust_ma in (0.0, gate.vent_current_ma, float(model.current_max_ma))
        )
        if shut - vent < VENT_PART * (shut - full):
            raise BadConfig(
                f"key 'valves.vent_current_ma': {gate.vent_current_ma:g} mA vents {pressure_kpa:g} kPa at {shut - vent:.0f} "
                f"kPa/s by the model of '{bench.controller.parameters}'; full current does at {shut - full:.0f} kPa/s, "
                f"and at least half of that is needed"
            )
