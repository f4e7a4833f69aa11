import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.dynamics.gas import ATMOSPHERE_PA, C1, GAS_CONSTANT, KAPPA, mass_flux
from softloop.dynamics.parameters import load_parameters, model_record, shipped
from softloop.dynamics.pneumatics import pressure_rate
from softloop.plant.air import flux, rig_air_slopes, static_air_slopes, valve_flows
from softloop.plant.parameters import draw_rig
from softloop.plant.records import ANGLE, AREA_IN, AREA_OUT, CHAMBER, GAS_K, RATE, STATE, SUPPLY, TUBE
from softloop.wire.kernel import new_record

PARAMETERS = load_parameters(shipped())
MODEL = model_record(PARAMETERS)
IDEAL = draw_rig("ideal", 1, PARAMETERS).air
KPA = st.floats(-5.0, 200.0)
MA = st.floats(0.0, 220.0)


def rig_air(seed=1):
    return draw_rig("rig", seed, PARAMETERS).air


def still(air, kpa):
    """A state at one pressure, temperature of the walls, valves shut, at the angle of the nominal volume."""
    state = new_record(STATE)
    state.stage[ANGLE] = air.volume_angle_deg
    state.stage[TUBE] = state.stage[CHAMBER] = kpa
    state.stage[SUPPLY], state.stage[GAS_K] = air.supply_kpa, air.wall_k
    return state


@given(KPA, MA, MA)
def test_the_ideal_layer_is_the_controllers_model(chamber, charge, exhaust):
    state = new_record(STATE)
    state.stage[CHAMBER] = chamber
    static_air_slopes(IDEAL, state, charge, exhaust)
    expected = pressure_rate(MODEL, MODEL.theta, MODEL.supply_kpa, chamber, charge, exhaust)
    assert state.slope[CHAMBER] == pytest.approx(expected, rel=1e-10, abs=1e-10)


@given(st.floats(1e4, 4e5), st.floats(1e4, 4e5))
def test_flux_is_that_of_the_dynamics(first, second):
    assert flux(0.8 / np.sqrt(293.15), first, second) == pytest.approx(mass_flux(first, second, 293.15, 0.8), rel=1e-12)


def test_a_choked_valve_passes_what_the_corrected_constant_says():
    into, _ = valve_flows(IDEAL, 200.0, 20.0, 1e-7, 0.0)
    assert into == pytest.approx(0.8 * 1e-7 * (200e3 + ATMOSPHERE_PA) / np.sqrt(293.15) * C1, rel=1e-12)
    assert pytest.approx(0.04041842, rel=1e-6) == C1


def test_shut_and_even_nothing_happens():
    air = rig_air()
    air.leak_m2 = air.leak_laminar_kg_s_pa = 0.0
    state = still(air, 60.0)
    rig_air_slopes(air, state, 0.0, 0.0)
    assert np.all(state.slope[[CHAMBER, TUBE, GAS_K, AREA_IN, AREA_OUT]] == 0.0)
    assert state.slope[SUPPLY] == pytest.approx(0.0, abs=1e-9)


def test_a_growing_chamber_cools_by_the_adiabatic_law():
    air = rig_air()
    state = still(air, 60.0)
    state.stage[RATE] = 80.0
    rig_air_slopes(air, state, 0.0, 0.0)
    growth = air.volume_per_deg * 80.0  # 1/s, at the angle of the nominal volume
    assert state.slope[CHAMBER] == pytest.approx(-KAPPA * (60.0 + 101.325) * growth, rel=1e-12)
    assert state.slope[GAS_K] == pytest.approx(-(KAPPA - 1.0) * air.wall_k * growth, rel=1e-12)


def test_the_wall_draws_the_gas_back_with_its_lag():
    air = rig_air()
    state = still(air, 60.0)
    state.stage[GAS_K] = air.wall_k + 10.0
    rig_air_slopes(air, state, 0.0, 0.0)
    mass_kg = (60e3 + ATMOSPHERE_PA) * air.volume_m3 / (GAS_CONSTANT * state.stage[GAS_K])
    heat_w = -air.wall_w_k * 10.0
    assert state.slope[GAS_K] == pytest.approx(heat_w / (mass_kg * GAS_CONSTANT / (KAPPA - 1.0)), rel=1e-9)


@given(st.floats(0.0, 150.0), st.floats(-20.0, 20.0))
def test_what_leaves_the_tube_enters_the_chamber(chamber, excess):
    air = rig_air()
    air.leak_m2 = air.leak_laminar_kg_s_pa = 0.0
    state = still(air, chamber)
    state.stage[TUBE] = chamber + excess
    rig_air_slopes(air, state, 0.0, 0.0)
    x, slope = state.stage, state.slope
    from_tube = slope[TUBE] * 1e3 * air.tube_volume_m3 / (GAS_CONSTANT * air.wall_k)
    pressure = 1e3 * x[CHAMBER] + ATMOSPHERE_PA
    mass = pressure * air.volume_m3 / (GAS_CONSTANT * x[GAS_K])
    into_chamber = mass * (1e3 * slope[CHAMBER] / pressure - slope[GAS_K] / x[GAS_K])
    assert from_tube + into_chamber == pytest.approx(0.0, abs=1e-12)
    assert from_tube * excess <= 0.0


def test_the_supply_droops_under_flow():
    air = rig_air()
    state = still(air, 60.0)
    state.stage[AREA_IN] = 6e-7
    rig_air_slopes(air, state, 220.0, 0.0)
    into, _ = valve_flows(air, air.supply_kpa, 60.0, 6e-7, 0.0)
    fall_kpa = -state.slope[SUPPLY] / air.supply_rate
    assert fall_kpa == pytest.approx(air.supply_droop_kpa_s_kg * into)
    assert 0.02 * 200.0 < fall_kpa < 0.05 * 200.0
