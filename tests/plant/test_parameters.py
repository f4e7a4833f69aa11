import numpy as np
import pytest
from pydantic import ValidationError

from softloop.dynamics.bending import bending_drift
from softloop.dynamics.gas import ATMOSPHERE_PA, mass_flux
from softloop.dynamics.parameters import B0, LEAK, load_parameters, model_record, shipped
from softloop.plant import records
from softloop.plant.config import PlantConfig
from softloop.plant.mismatch import draw
from softloop.plant.parameters import HYSTERESIS_DEG_S2, draw_rig
from softloop.plant.setup import plant_record

PARAMETERS = load_parameters(shipped())
MODEL = model_record(PARAMETERS)


def test_the_ideal_layer_takes_the_models_numbers():
    rig = draw_rig("ideal", 7, PARAMETERS)
    assert np.array_equal(rig.mechanics.theta, MODEL.theta)
    assert rig.air.volume_m3 == MODEL.volume_m3
    assert rig.air.leak_m2 == MODEL.theta[LEAK]
    assert rig.air.supply_kpa == MODEL.supply_kpa
    assert (rig.air.exponent, rig.air.leak_laminar_kg_s_pa, rig.air.coil_lag_s, rig.air.play_charge_ma) == (1.0, 0.0, 0.0, 0.0)
    assert not rig.mechanics.memory


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_rig_layer_divides_its_draws_between_its_parts(seed):
    rig, drawn = draw_rig("rig", seed, PARAMETERS), draw(seed)
    air = rig.air
    assert air.volume_m3 + air.tube_volume_m3 == pytest.approx(drawn.volume * MODEL.volume_m3, rel=1e-12)
    at_pa, hot_k = 60e3, drawn.ambient_c + 273.15
    flux = mass_flux(at_pa + ATMOSPHERE_PA, ATMOSPHERE_PA, hot_k, MODEL.discharge)
    leak = air.leak_m2 * flux + air.leak_laminar_kg_s_pa * at_pa
    assert leak == pytest.approx(drawn.leak * MODEL.theta[LEAK] * flux, rel=1e-12)
    assert 0.05 * 220.0 <= 2.0 * air.play_charge_ma <= 0.10 * 220.0
    assert rig.mechanics.stop_stiffness @ rig.mechanics.stop_deg == pytest.approx(HYSTERESIS_DEG_S2, rel=1e-12)


def test_theta_is_inside_its_bounds_before_temperature_softens_it():
    for seed in range(50):
        theta = draw_rig("rig", seed, PARAMETERS).mechanics.theta.copy()
        softness = 1.0 - 3e-3 * (draw(seed).ambient_c - 20.0)
        theta[[0, 1, 2, 7]] /= softness
        assert np.all(theta[:9] >= MODEL.theta_min[:9] * (1.0 - 1e-12))
        assert np.all(theta[:9] <= MODEL.theta_max[:9] * (1.0 + 1e-12))


def test_the_rest_angle_is_at_rest():
    for seed in range(20):
        mechanics = draw_rig("rig", seed, PARAMETERS).mechanics
        assert bending_drift(mechanics.theta, mechanics.rest_deg, 0.0) == pytest.approx(0.0, abs=1e-9)
        assert 24.0 < mechanics.rest_deg < 30.0


def fields(dtype):
    for name in dtype.names:
        yield name
        inner = dtype[name].subdtype[0] if dtype[name].subdtype else dtype[name]
        if inner.names:
            yield from fields(inner)


@pytest.mark.parametrize("dtype", [records.PLANT, records.STATE, records.EVENT])
def test_no_field_hides_behind_an_attribute_of_numpys_records(dtype):
    # A field called `size` would read 1 in plain Python and its value when compiled.
    assert [name for name in fields(dtype) if hasattr(np.void, name)] == []


@pytest.mark.parametrize("layer", ["ideal", "rig"])
def test_a_tank_is_tight_rigid_and_of_its_volume_and_moves_no_actuator(layer):
    params = plant_record(PlantConfig(layer=layer, tank_ml=500.0, supply_kpa=170.0))
    air = params.air
    assert air.volume_m3 + air.tube_volume_m3 == pytest.approx(500e-6, rel=1e-12)
    assert (air.leak_m2, air.leak_laminar_kg_s_pa, air.volume_per_deg, air.supply_kpa) == (0.0, 0.0, 0.0, 170.0)
    assert params.mechanics.theta[B0] == 0.0


def test_a_tank_smaller_than_its_tubing_is_refused():
    with pytest.raises(ValidationError, match="tank_ml must be 0 or at least 100"):
        PlantConfig(tank_ml=20.0)
