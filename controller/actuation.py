"""From demanded flow to a working mode and two currents; shared by every law."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from softloop.controller.records import (
    ACTUATION_TYPE,
    DEMAND_TYPE,
    MEASUREMENT_TYPE,
    MODE_CHARGE,
    MODE_EXHAUST,
    MODE_HOLD,
    MODES_LATCHED,
    MODES_TABLE_2,
    REFERENCE_TYPE,
    STATE_TYPE,
)
from softloop.dynamics.gas import PA_PER_KPA
from softloop.dynamics.parameters import KV1_CHARGE, KV1_EXHAUST, KV6_CHARGE, KV6_EXHAUST, LEAK, MODEL_TYPE, THETA_TYPE
from softloop.dynamics.pneumatics import known_terms
from softloop.dynamics.valve import current_for_area
from softloop.wire.kernel import kernel

_F8 = types.f8
# Below about 0.5 kPa the exhaust moves next to nothing and Eq. 45 divides by its flow; the floor is f1 at about that pressure.
_FLOW_FLOOR = 5.0e7  # (kPa/s)/m2


@kernel(types.i8(ACTUATION_TYPE, REFERENCE_TYPE, _F8, types.i8))
def table_2_mode(settings: Any, reference: Any, error: float, mode: int) -> int:
    """The paper's Table 2: the mode from the reference's direction, and from the error where the reference stands."""
    if reference.rate > settings.rate_still_deg_s:
        return MODE_CHARGE
    if reference.rate < -settings.rate_still_deg_s:
        return MODE_EXHAUST
    bound = settings.error_release if mode == MODE_HOLD else settings.error_hold
    if error > bound:
        return MODE_EXHAUST
    if error < -bound:
        return MODE_CHARGE
    return MODE_HOLD


@kernel(types.i8(ACTUATION_TYPE, REFERENCE_TYPE, _F8, _F8, types.i8))
def flow_mode(settings: Any, reference: Any, error: float, flow_kpa_s: float, mode: int) -> int:
    """The mode from the sign of the demanded flow; hold while reference and error stand still within their bounds."""
    bound = settings.error_release if mode == MODE_HOLD else settings.error_hold
    if abs(reference.rate) <= settings.rate_still_deg_s and abs(error) < bound:
        return MODE_HOLD
    if flow_kpa_s > settings.flow_hold_kpa_s:
        return MODE_CHARGE
    if flow_kpa_s < -settings.flow_hold_kpa_s:
        return MODE_EXHAUST
    return MODE_HOLD


@kernel(types.i8(ACTUATION_TYPE, _F8, types.i8))
def latched_mode(settings: Any, flow_kpa_s: float, mode: int) -> int:
    """A valve keeps its turn, shut if need be, until the other way is asked for by more than `flow_hold_kpa_s`.

    On a dwell the leak then does the exhausting, and the charge valve alone holds the pressure, with no switch.
    """
    if flow_kpa_s > (-settings.flow_hold_kpa_s if mode == MODE_CHARGE else settings.flow_hold_kpa_s):
        return MODE_CHARGE
    if flow_kpa_s < (settings.flow_hold_kpa_s if mode == MODE_EXHAUST else -settings.flow_hold_kpa_s):
        return MODE_EXHAUST
    return mode


@kernel(types.i8(ACTUATION_TYPE, REFERENCE_TYPE, _F8, _F8, STATE_TYPE))
def choose_mode(settings: Any, reference: Any, error: float, flow_kpa_s: float, state: Any) -> int:
    """The working mode of this tick; a mode once taken stays for `switch_ticks`. Updates `state.mode`."""
    if settings.rule == MODES_TABLE_2:
        wanted = table_2_mode(settings, reference, error, state.mode)
    elif settings.rule == MODES_LATCHED:
        wanted = latched_mode(settings, flow_kpa_s, state.mode)
    else:
        wanted = flow_mode(settings, reference, error, flow_kpa_s, state.mode)
    state.mode_ticks += 1
    if wanted != state.mode and (state.mode_ticks >= settings.switch_ticks or state.mode == MODE_HOLD):
        state.mode = wanted
        state.mode_ticks = 0
    return state.mode


@kernel(_F8(MODEL_TYPE, THETA_TYPE, types.b1, _F8, _F8))
def opening_current(model: Any, theta: np.ndarray, charging: bool, supply_kpa: float, chamber_kpa: float) -> float:
    """The current at which a valve just opens, by the model; mA."""
    supply_pa, chamber_pa = PA_PER_KPA * supply_kpa, PA_PER_KPA * chamber_kpa
    if charging:
        return current_for_area(model.charge, theta[KV1_CHARGE], theta[KV6_CHARGE], 0.0, supply_pa, chamber_pa)
    return current_for_area(model.exhaust, theta[KV1_EXHAUST], theta[KV6_EXHAUST], 0.0, chamber_pa, 0.0)


@kernel(_F8(MODEL_TYPE, THETA_TYPE, types.b1, _F8, _F8, _F8))
def current_for_flow(
    model: Any, theta: np.ndarray, charging: bool, supply_kpa: float, chamber_kpa: float, flow_kpa_s: float
) -> float:
    """Eq. 25 solved for the current, mA, not limited: `flow_kpa_s` is the pressure rate wanted of the valve alone."""
    f1, f2, _ = known_terms(model, charging, supply_kpa, chamber_kpa)
    if charging:
        return (flow_kpa_s - f2) / (theta[KV1_CHARGE] * max(f1, _FLOW_FLOOR)) + theta[KV6_CHARGE] / theta[KV1_CHARGE]
    return (flow_kpa_s - f2) / (theta[KV1_EXHAUST] * min(f1, -_FLOW_FLOOR)) + theta[KV6_EXHAUST] / theta[KV1_EXHAUST]


@kernel(types.void(ACTUATION_TYPE, MODEL_TYPE, MEASUREMENT_TYPE, DEMAND_TYPE, STATE_TYPE))
def actuate(settings: Any, model: Any, measurement: Any, demand: Any, state: Any) -> None:
    """Set both currents in `state` from the demand; `state.saturated` says that the valve cannot give what is asked.

    The closed valve waits just below its opening current, so that its dead zone does not have to be crossed at a switch.
    """
    theta, supply, chamber = state.theta, measurement.supply_kpa, measurement.chamber_kpa
    bias = settings.bias_fraction
    state.charge_before_ma = state.charge_ma
    state.exhaust_before_ma = state.exhaust_ma
    charge = bias * opening_current(model, theta, True, supply, chamber)
    exhaust = bias * opening_current(model, theta, False, supply, chamber)
    state.saturated = 0
    if demand.mode != MODE_HOLD:
        charging = demand.mode == MODE_CHARGE
        _, _, f3 = known_terms(model, charging, supply, chamber)
        flow = demand.flow_kpa_s + f3 * theta[LEAK]
        wanted = current_for_flow(model, theta, charging, supply, chamber, flow)
        given = min(max(wanted, 0.0), settings.current_max_ma)
        state.saturated = wanted != given
        if charging:
            charge = given
        else:
            exhaust = given
    state.charge_ma = min(max(charge, 0.0), settings.current_max_ma)
    state.exhaust_ma = min(max(exhaust, 0.0), settings.current_max_ma)
