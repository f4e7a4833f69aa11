"""Step 2 of the controller alone, Eqs. 41 to 46 with a given desired pressure: for excitation and for pressure runs."""

from __future__ import annotations

from math import tanh
from typing import Any

from numba import types

from softloop.controller.actuation import choose_mode
from softloop.controller.records import DEMAND_TYPE, GAINS_TYPE, MEASUREMENT_TYPE, REFERENCE_TYPE, STATE_TYPE
from softloop.controller.robust import SMOOTH
from softloop.wire.kernel import kernel


@kernel(types.void(MEASUREMENT_TYPE, REFERENCE_TYPE, GAINS_TYPE, STATE_TYPE, DEMAND_TYPE))
def pressure_step(measurement: Any, reference: Any, gains: Any, state: Any, demand: Any) -> None:
    """The flow that takes the chamber to the reference pressure; `reference` is in kPa, its rate is P_vdc' of Eq. 42."""
    g = gains.pressure
    s2 = measurement.chamber_kpa - reference.value
    robust = g.delta2 * tanh(SMOOTH * g.delta2 * s2 / g.epsilon2)
    demand.desired_pressure_kpa = reference.value
    demand.error = 0.0
    demand.s1 = 0.0
    demand.s2 = s2
    demand.flow_kpa_s = reference.rate - g.k2 * s2 - robust
    demand.mode = choose_mode(gains.actuation, reference, s2, demand.flow_kpa_s, state)
