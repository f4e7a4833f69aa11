"""The rig's true state as a PlantTruth message."""

from __future__ import annotations

from typing import Any

from numba import types

from softloop.dynamics.valve import orifice_area
from softloop.plant.mechanics import creep, hysteresis, load
from softloop.plant.physics import block_kpa
from softloop.plant.records import (
    ANGLE,
    AREA_IN,
    AREA_OUT,
    CHAMBER,
    CREEP_0,
    GAS_K,
    PLANT_TYPE,
    RATE,
    STATE_TYPE,
    SUPPLY,
)
from softloop.wire.kernel import kernel

_MM2 = 1e6
_PA = 1000.0
# What counts as no current, an open exhaust and an empty chamber.
CHARGE_OFF_MA, EXHAUST_OPEN_MM2, EMPTY_KPA = 1.0, 0.05, 5.0


@kernel(types.void(PLANT_TYPE, STATE_TYPE))
def _note_areas(params: Any, state: Any) -> None:
    air, x, truth = params.air, state.x, state.truth
    area_in, area_out = x[AREA_IN], x[AREA_OUT]
    if not params.rig:
        supply_pa, block_pa = _PA * x[SUPPLY], _PA * block_kpa(params, state)
        area_in = orifice_area(air.charge, air.k_v1_charge, air.k_v6_charge, state.play_charge_ma, supply_pa, block_pa)
        area_out = orifice_area(air.exhaust, air.k_v1_exhaust, air.k_v6_exhaust, state.play_exhaust_ma, block_pa, 0.0)
    truth.charge_area_mm2, truth.exhaust_area_mm2 = _MM2 * area_in, _MM2 * area_out


@kernel(types.i8(types.b1, types.i8, types.i8))
def _since(holds: bool, before_ns: int, now_ns: int) -> int:
    """Since when something holds, 0 while it does not; `before_ns` is what this was at the last truth."""
    if not holds:
        return 0
    return before_ns if before_ns != 0 else now_ns


@kernel(types.void(STATE_TYPE))
def _note_since(state: Any) -> None:
    """A log that heard nothing for a while knows by this when it began."""
    truth = state.truth
    truth.charge_off_ns = _since(truth.charge_coil_ma < CHARGE_OFF_MA, truth.charge_off_ns, truth.stamp_ns)
    truth.exhaust_open_ns = _since(truth.exhaust_area_mm2 > EXHAUST_OPEN_MM2, truth.exhaust_open_ns, truth.stamp_ns)
    truth.empty_ns = _since(truth.chamber_pressure_kpa < EMPTY_KPA, truth.empty_ns, truth.stamp_ns)


@kernel(types.void(PLANT_TYPE, STATE_TYPE))
def note_truth(params: Any, state: Any) -> None:
    """Fill `state.truth` for `state.t_ns`; the process adds deadline misses and lateness."""
    mechanics, memory, x, truth = params.mechanics, state.memory, state.x, state.truth
    truth.seq += 1
    truth.stamp_ns = state.t_ns
    truth.angle_deg, truth.rate_deg_s = x[ANGLE], x[RATE]
    truth.chamber_pressure_kpa, truth.supply_pressure_kpa = x[CHAMBER], x[SUPPLY]
    truth.charge_coil_ma, truth.exhaust_coil_ma = state.coil_charge_ma, state.coil_exhaust_ma
    _note_areas(params, state)
    _note_since(state)
    truth.gas_temperature_k = x[GAS_K]
    truth.hysteresis_deg_s2, truth.creep_deg_s2 = 0.0, 0.0
    if mechanics.memory:
        truth.hysteresis_deg_s2 = hysteresis(mechanics, memory, x[ANGLE])
        truth.creep_deg_s2 = creep(mechanics, x[ANGLE], x[CREEP_0], x[CREEP_0 + 1], x[CREEP_0 + 2])
    truth.load_deg_s2 = load(mechanics, memory, x[ANGLE], x[RATE])
    truth.command_counter = state.driver.accepted
    truth.command_end_ns, truth.command_applied_ns = state.driver.command_end_ns, state.driver.command_applied_ns
    truth.integration_steps = state.steps
    truth.driver = state.driver.state
    truth.load = (1 if memory.payload_deg_s2 > 0.0 else 0) + (2 if memory.contact_1_s2 > 0.0 else 0)
