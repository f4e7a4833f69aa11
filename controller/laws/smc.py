"""C2: smooth sliding mode control, which by the paper's text is the ARC without its adaptation, with gains of its own."""

from __future__ import annotations

from typing import Any

from numba import types

from softloop.controller.laws.arc import STEP1_TYPE, backstep
from softloop.controller.records import DEMAND_TYPE, GAINS_TYPE, MEASUREMENT_TYPE, REFERENCE_TYPE, STATE_TYPE
from softloop.dynamics.parameters import MODEL_TYPE
from softloop.wire.kernel import kernel


@kernel(types.void(MODEL_TYPE, MEASUREMENT_TYPE, REFERENCE_TYPE, GAINS_TYPE, STATE_TYPE, STEP1_TYPE, DEMAND_TYPE))
def smc_step(model: Any, measurement: Any, reference: Any, gains: Any, state: Any, first: Any, demand: Any) -> None:
    """One step of C2; fills `demand`. The parameters stay where they are."""
    measurement.adapt = 0
    backstep(model, measurement, reference, gains.actuation, gains.smc, state, first, demand)
