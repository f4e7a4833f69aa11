"""Flow tests of the valves: the currents of a plan as they are, one valve at a time, while the pressure stays within two limits.

The plan's value is a current: above zero the charge valve's, below zero the exhaust valve's. Nothing is predicted or corrected.
"""

from __future__ import annotations

from typing import Any

from numba import types

from softloop.controller.records import (
    DEMAND_TYPE,
    GAINS_TYPE,
    MEASUREMENT_TYPE,
    MODE_CHARGE,
    MODE_EXHAUST,
    MODE_HOLD,
    REFERENCE_TYPE,
    STATE_TYPE,
)
from softloop.wire.kernel import kernel

_BAND_KPA = 3.0  # a valve that was shut at a limit opens again only this far inside it


@kernel(types.void(MEASUREMENT_TYPE, REFERENCE_TYPE, GAINS_TYPE, STATE_TYPE, DEMAND_TYPE))
def valve_test_step(measurement: Any, reference: Any, gains: Any, state: Any, demand: Any) -> None:
    """Both currents into `state`, and the mode that they are; `reference` is a current in mA."""
    asked, chamber = reference.value, measurement.chamber_kpa
    band = _BAND_KPA if state.mode == MODE_HOLD else 0.0
    mode = MODE_HOLD
    if asked > 0.0 and chamber < gains.valve_test.top_kpa - band:
        mode = MODE_CHARGE
    elif asked < 0.0 and chamber > gains.valve_test.low_kpa + band:
        mode = MODE_EXHAUST
    state.charge_before_ma, state.exhaust_before_ma = state.charge_ma, state.exhaust_ma
    state.charge_ma = asked if mode == MODE_CHARGE else 0.0
    state.exhaust_ma = -asked if mode == MODE_EXHAUST else 0.0
    state.mode, state.saturated = mode, 0
    demand.flow_kpa_s, demand.desired_pressure_kpa = 0.0, 0.0
    demand.error, demand.s1, demand.s2, demand.mode = 0.0, 0.0, 0.0, mode
