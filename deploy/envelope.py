"""The gate's limits beside what the controller will ask for: said before anything moves, and not by a FAULT amid it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from softloop.deploy.bench import Bench
from softloop.wire.errors import BadConfig

if TYPE_CHECKING:
    from softloop.controller.setup import Controller

_STEP_S = 0.01


def check_envelope(bench: Bench, controller: Controller) -> None:
    """The largest current and the trajectory lie within the gate's limits. Raises BadConfig."""
    if bench.valves is None or bench.controller is None:
        return
    _check_current(bench, controller)
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
