"""The air's way: supply with its regulator, two valves, tube, chamber, leak; mass and energy balances.

All state pressures are kPa gauge. The pressure sensor and the valves sit at one block; a tube leads from there to the chamber.
In the ideal layer there is no tube, and the balance is Eq. 11 with the valves' Eq. 16, as the controller knows it.
"""

from __future__ import annotations

from typing import Any

from numba import types

from softloop.dynamics.gas import ATMOSPHERE_PA, GAS_CONSTANT, PA_PER_KPA, flow_function
from softloop.dynamics.parameters import VALVE_SHAPE_TYPE
from softloop.dynamics.valve import orifice_area
from softloop.plant.records import AIR_TYPE, AREA_IN, AREA_OUT, CHAMBER, GAS_K, RATE, STATE_TYPE, SUPPLY, TUBE
from softloop.wire.kernel import kernel

_F8 = types.f8
_TWO = types.UniTuple(_F8, 2)


@kernel(_F8(_F8, _F8, _F8))
def flux(flow_scale: float, first_pa: float, second_pa: float) -> float:
    """g2 of Eq. 21, kg/(s m2), from absolute pressures, with C_f / sqrt(T) made once."""
    if first_pa >= second_pa:
        return flow_scale * first_pa * flow_function(second_pa / first_pa)
    return -flow_scale * second_pa * flow_function(first_pa / second_pa)


@kernel(_TWO(AIR_TYPE, _F8, _F8, _F8, _F8))
def valve_flows(air: Any, supply_kpa: float, block_kpa: float, area_in_m2: float, area_out_m2: float) -> tuple[float, float]:
    """Mass flow into the block through the charge valve, and out of it through exhaust valve and leaks, kg/s."""
    block_pa = PA_PER_KPA * block_kpa + ATMOSPHERE_PA
    into = 0.0
    if area_in_m2 > 0.0:
        into = area_in_m2 * flux(air.flow_scale, PA_PER_KPA * supply_kpa + ATMOSPHERE_PA, block_pa)
    out = (max(area_out_m2, 0.0) + air.leak_m2) * flux(air.flow_scale, block_pa, ATMOSPHERE_PA)
    return into, out + air.leak_laminar_kg_s_pa * (block_pa - ATMOSPHERE_PA)


@kernel(types.void(AIR_TYPE, STATE_TYPE, _F8, _F8))
def static_air_slopes(air: Any, state: Any, charge_ma: float, exhaust_ma: float) -> None:
    """The ideal layer: Eqs. 11 and 16 to 19, isothermal, at a constant supply; writes the chamber's slope."""
    chamber, supply_kpa = state.stage[CHAMBER], air.supply_kpa * (1.0 - state.broken.supply_lost)
    supply_pa, chamber_pa = PA_PER_KPA * supply_kpa, PA_PER_KPA * chamber
    area_in = orifice_area(air.charge, air.k_v1_charge, air.k_v6_charge, charge_ma, supply_pa, chamber_pa)
    area_out = orifice_area(air.exhaust, air.k_v1_exhaust, air.k_v6_exhaust, exhaust_ma, chamber_pa, 0.0)
    area_in = max(area_in, 0.0) + state.broken.charge_leak_m2
    into, out = valve_flows(air, supply_kpa, chamber, area_in, area_out + state.broken.burst_m2)
    state.slope[CHAMBER] = GAS_CONSTANT * air.wall_k / (PA_PER_KPA * air.volume_m3) * (into - out)


@kernel(types.void(AIR_TYPE, STATE_TYPE, _F8, _F8))
def _chamber_slopes(air: Any, state: Any, chamber_pa: float, line_kg_s: float) -> None:
    """First law for the gas in a chamber that grows as it bends, with heat from its wall."""
    x, slope = state.stage, state.slope
    gas_k = x[GAS_K]
    volume = air.volume_m3 * (1.0 + air.volume_per_deg * (x[0] - air.volume_angle_deg))
    growth = air.volume_m3 * air.volume_per_deg * x[RATE]
    flowing_k = air.wall_k if line_kg_s > 0.0 else gas_k
    heat_w = air.wall_w_k * (air.wall_k - gas_k)
    enthalpy = GAS_CONSTANT * flowing_k * line_kg_s
    per_volume = 1.0 / volume
    rise_pa = (air.exponent * (enthalpy - chamber_pa * growth) + (air.exponent - 1.0) * heat_w) * per_volume
    slope[CHAMBER] = rise_pa / PA_PER_KPA
    slope[GAS_K] = gas_k * ((rise_pa - GAS_CONSTANT * gas_k * line_kg_s * per_volume) / chamber_pa + growth * per_volume)


@kernel(types.void(AIR_TYPE, VALVE_SHAPE_TYPE, STATE_TYPE, types.i8, _F8, _F8, _F8))
def _spool_slopes(
    air: Any, shape: Any, state: Any, place: int, drive_m2: float, upstream_pa: float, downstream_pa: float
) -> None:
    """Eq. 13 in terms of the orifice area it opens, so that its rest is Eq. 16; against a stop the spool stands."""
    area, speed = state.stage[place], state.stage[place + 1]
    pull = drive_m2 - shape.k_v3_m2_pa * upstream_pa + shape.k_v5_m2_pa * downstream_pa
    spring = 1.0 - shape.k_v2_pa * upstream_pa + shape.k_v4_pa * downstream_pa
    push = air.spool_rad_s * (air.spool_rad_s * (pull - spring * area) - 2.0 * air.spool_damping * speed)
    state.push[(place - AREA_IN) // 2] = air.spool_rad_s**2 * (pull - spring * state.x[place])
    # Only what stood against a stop when the step began is held there: one that arrives goes on, and the step is divided.
    at_seat = state.x[place] <= 0.0 and area <= 0.0 and push <= 0.0
    at_end = state.x[place] >= shape.area_max_m2 and area >= shape.area_max_m2 and push >= 0.0
    if at_seat or at_end:
        speed, push = 0.0, 0.0
    state.slope[place] = speed
    state.slope[place + 1] = push


@kernel(types.void(AIR_TYPE, STATE_TYPE, _F8, _F8))
def rig_air_slopes(air: Any, state: Any, charge_ma: float, exhaust_ma: float) -> None:
    """The rig layer: writes the slopes of spools, supply, tube, chamber and gas temperature."""
    x, slope = state.stage, state.slope
    supply, block = x[SUPPLY], x[TUBE]
    open_out = max(min(x[AREA_OUT], air.exhaust.area_max_m2), 0.0) + state.broken.burst_m2
    open_in = max(min(x[AREA_IN], air.charge.area_max_m2), 0.0) + state.broken.charge_leak_m2
    into, out = valve_flows(air, supply, block, open_in, open_out)
    block_pa = PA_PER_KPA * block + ATMOSPHERE_PA
    chamber_pa = PA_PER_KPA * x[CHAMBER] + ATMOSPHERE_PA
    line = air.tube_kg_s_pa2 * (block_pa - chamber_pa) * (block_pa + chamber_pa)
    slope[SUPPLY] = (
        air.supply_kpa * (1.0 - state.broken.supply_lost) - air.supply_droop_kpa_s_kg * into - supply
    ) * air.supply_rate
    slope[TUBE] = GAS_CONSTANT * air.wall_k / (PA_PER_KPA * air.tube_volume_m3) * (into - out - line)
    _chamber_slopes(air, state, chamber_pa, line)
    supply_pa, block_gauge_pa = PA_PER_KPA * supply, PA_PER_KPA * block
    _spool_slopes(air, air.charge, state, AREA_IN, air.k_v1_charge * charge_ma - air.k_v6_charge, supply_pa, block_gauge_pa)
    _spool_slopes(air, air.exhaust, state, AREA_OUT, air.k_v1_exhaust * exhaust_ma - air.k_v6_exhaust, block_gauge_pa, 0.0)


@kernel(types.void(VALVE_SHAPE_TYPE, STATE_TYPE, types.i8))
def stop_spool(shape: Any, state: Any, place: int) -> None:
    """After a step: a spool that reached a stop stays there, without a bounce."""
    if state.x[place] < 0.0:
        state.x[place] = 0.0
        state.x[place + 1] = max(state.x[place + 1], 0.0)
    elif state.x[place] > shape.area_max_m2:
        state.x[place] = shape.area_max_m2
        state.x[place + 1] = min(state.x[place + 1], 0.0)
