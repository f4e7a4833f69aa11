"""From demanded flow to two currents for the laws with an observer: the valves' inverse with what has been learned of them.

Each valve's model is shifted by the offset that the observer has found, and its hysteresis is undone by the inverse of a play
operator of nominal width. What both currents, after all limits, do to the chamber goes back to the observer.
"""

from __future__ import annotations

from typing import Any

from numba import types

from softloop.controller.actuation import current_for_flow, opening_current
from softloop.controller.flows import remember_flow
from softloop.controller.observer import valve_open
from softloop.controller.records import DEMAND_TYPE, GAINS_TYPE, MEASUREMENT_TYPE, MODE_CHARGE, MODE_HOLD, STATE_TYPE
from softloop.dynamics.gas import ATMOSPHERE_PA, PA_PER_KPA
from softloop.dynamics.parameters import LEAK, MODEL_TYPE
from softloop.dynamics.pneumatics import known_terms, pressure_rate
from softloop.wire.kernel import kernel

_F8 = types.f8


@kernel(_F8(_F8, _F8, _F8))
def play_after(current_ma: float, felt_ma: float, half_width_ma: float) -> float:
    """What a spool feels of a current behind a hysteresis loop of twice `half_width_ma`, having felt `felt_ma` before."""
    return max(current_ma - half_width_ma, min(current_ma + half_width_ma, felt_ma))


@kernel(_F8(_F8, _F8, _F8, _F8, _F8))
def current_to_feel(wanted_ma: float, felt_ma: float, half_width_ma: float, still_ma: float, before_ma: float) -> float:
    """The current that makes a spool feel `wanted_ma`: the inverse of the play. Within `still_ma` of it nothing is moved."""
    if wanted_ma > felt_ma + still_ma:
        return wanted_ma + half_width_ma
    if wanted_ma < felt_ma - still_ma:
        return wanted_ma - half_width_ma
    return min(max(before_ma, felt_ma - half_width_ma), felt_ma + half_width_ma)


@kernel(_F8(GAINS_TYPE, MEASUREMENT_TYPE))
def growth_rate(gains: Any, measurement: Any) -> float:
    """The pressure rate that the growing chamber takes, kPa/s: P V'/V of the absolute pressure, which Eq. 11 leaves out."""
    absolute_kpa = measurement.chamber_kpa + ATMOSPHERE_PA / PA_PER_KPA
    return absolute_kpa * gains.observer.growth_1_deg * measurement.rate_deg_s


@kernel(_F8(GAINS_TYPE, MODEL_TYPE, MEASUREMENT_TYPE, DEMAND_TYPE, STATE_TYPE, types.b1))
def wanted_current(gains: Any, model: Any, measurement: Any, demand: Any, state: Any, charging: bool) -> float:
    """The current that a valve should feel for the demanded flow, mA, not limited."""
    supply, chamber = measurement.supply_kpa, measurement.chamber_kpa
    offset = state.observer.charge_offset_ma if charging else state.observer.exhaust_offset_ma
    _, _, f3 = known_terms(model, charging, supply, chamber)
    flow = demand.flow_kpa_s + f3 * state.theta[LEAK] + growth_rate(gains, measurement)
    return current_for_flow(model, state.theta, charging, supply, chamber, flow) + offset


@kernel(types.void(GAINS_TYPE, MODEL_TYPE, MEASUREMENT_TYPE, DEMAND_TYPE, STATE_TYPE))
def drive_valves(gains: Any, model: Any, measurement: Any, demand: Any, state: Any) -> None:
    """Set both currents in `state`; `state.saturated` says that the valve cannot give what is asked."""
    settings, observer, g = gains.actuation, state.observer, gains.observer
    supply, chamber, top = measurement.supply_kpa, measurement.chamber_kpa, settings.current_max_ma
    # The valve that waits believes an offset only where it opens earlier: what was learned wrongly must not crack it open.
    charge = opening_current(model, state.theta, True, supply, chamber) + min(observer.charge_offset_ma, 0.0)
    exhaust = opening_current(model, state.theta, False, supply, chamber) + min(observer.exhaust_offset_ma, 0.0)
    charge, exhaust = settings.bias_fraction * charge, settings.bias_fraction * exhaust
    state.saturated = 0
    if demand.mode != MODE_HOLD:
        charging = demand.mode == MODE_CHARGE
        wanted = wanted_current(gains, model, measurement, demand, state, charging)
        given = min(max(wanted, charge if charging else exhaust), top)  # a valve that is shut waits just below its opening
        state.saturated = wanted > top
        if charging:
            charge = current_to_feel(given, observer.charge_play_ma, g.play_ma, g.play_still_ma, state.charge_ma)
        else:
            exhaust = current_to_feel(given, observer.exhaust_play_ma, g.play_ma, g.play_still_ma, state.exhaust_ma)
    state.charge_before_ma, state.exhaust_before_ma = state.charge_ma, state.exhaust_ma
    state.charge_ma = min(max(charge, 0.0), top)
    state.exhaust_ma = min(max(exhaust, 0.0), top)


@kernel(types.void(GAINS_TYPE, MODEL_TYPE, MEASUREMENT_TYPE, DEMAND_TYPE, STATE_TYPE, types.i8))
def note_flow(gains: Any, model: Any, measurement: Any, demand: Any, state: Any, ticks: int) -> None:
    """Tell the observer what the currents of this tick will do; the ones before have stood for `ticks` ticks."""
    observer, half = state.observer, gains.observer.play_ma
    observer.charge_play_ma = play_after(state.charge_ma, observer.charge_play_ma, half)
    observer.exhaust_play_ma = play_after(state.exhaust_ma, observer.exhaust_play_ma, half)
    flow = pressure_rate(
        model, state.theta, measurement.supply_kpa, measurement.chamber_kpa,
        observer.charge_play_ma - observer.charge_offset_ma, observer.exhaust_play_ma - observer.exhaust_offset_ma,
    )  # fmt: skip
    flow -= growth_rate(gains, measurement)
    if not valve_open(model, measurement.supply_kpa, state):
        flow += observer.hold_kpa_s
    remember_flow(observer, flow, ticks)
