import numpy as np
import pytest

from softloop.plant.physics import advance, settle_inputs
from softloop.plant.records import ANGLE, CHAMBER, GAS_K, SUPPLY, TUBE
from tests.plant.rigs import MS, Rig


def sealed(layer, kpa, **plant):
    """A rig shut at a pressure, without leaks."""
    rig = Rig(layer=layer, **plant)
    rig.params.air.leak_m2 = rig.params.air.leak_laminar_kg_s_pa = 0.0
    state = rig.state
    state.command_exhaust_ma = state.coil_exhaust_ma = state.play_exhaust_ma = 0.0
    settle_inputs(rig.params, rig.state)
    rig.state.x[CHAMBER] = kpa
    if layer == "rig":
        rig.state.x[TUBE] = kpa
        rig.state.x[9:13] = 0.0
    return rig


@pytest.mark.parametrize(("kpa", "deg"), [(0.0, 26.7), (20.0, 43.3), (60.0, 79.9), (100.0, 122.1)])
def test_the_ideal_static_map_is_that_of_table_1(kpa, deg):
    rig = sealed("ideal", kpa)
    advance(rig.params, rig.state, 10_000 * MS)
    assert rig.state.x[CHAMBER] == kpa
    assert rig.state.x[ANGLE] == pytest.approx(deg, abs=0.06)


def test_rk4_is_of_fourth_order_where_the_motion_is_smooth():
    ends = []
    for step_ns in (20 * MS, 10 * MS, 5 * MS, MS // 10):
        rig = sealed("ideal", 60.0)
        rig.params.step_ns = step_ns
        advance(rig.params, rig.state, 400 * MS)
        ends.append(rig.state.x[ANGLE])
    errors = np.abs(np.array(ends[:-1]) - ends[-1])
    orders = np.log2(errors[:-1] / errors[1:])
    assert np.all(np.abs(orders - 4.0) < 0.3)


def mass_kg(rig):
    """Of the gas in tube and chamber."""
    x, air = rig.state.x, rig.params.air
    volume = air.volume_m3 * (1.0 + air.volume_per_deg * (x[ANGLE] - air.volume_angle_deg))
    chamber = (1e3 * x[CHAMBER] + 101_325.0) * volume / x[GAS_K]
    return (chamber + (1e3 * x[TUBE] + 101_325.0) * air.tube_volume_m3 / air.wall_k) / 287.0


def test_shut_in_gas_keeps_its_mass_while_everything_moves():
    rig = sealed("rig", 80.0)
    before = mass_kg(rig)
    low = high = rig.state.x[GAS_K]
    for n in range(1, 200):
        advance(rig.params, rig.state, 10 * n * MS)
        low, high = min(low, rig.state.x[GAS_K]), max(high, rig.state.x[GAS_K])
    assert mass_kg(rig) == pytest.approx(before, rel=1e-9)
    assert rig.state.x[ANGLE] > 60.0
    assert low < rig.params.air.wall_k - 1.0  # it grew, and so cooled, and then the wall warmed it
    assert rig.state.x[GAS_K] > low


def free_motion(rig, seconds):
    """Largest angle less smallest one in the last second."""
    angles = []
    for n in range(1, round(100 * seconds)):
        advance(rig.params, rig.state, 10 * n * MS)
        angles.append(rig.state.x[ANGLE])
    return max(angles[-100:]) - min(angles[-100:])


def test_the_rig_comes_to_rest_by_itself():
    assert free_motion(sealed("rig", 60.0), 8.0) < 0.1


def test_a_slow_up_and_down_leaves_the_rig_where_hysteresis_holds_it():
    """The same pressure, from below and from above: several degrees apart in the rig layer, none in the ideal one."""
    gaps = []
    for layer in ("ideal", "rig"):
        angles = []
        for first in (20.0, 100.0):
            rig = sealed(layer, first)
            advance(rig.params, rig.state, 4_000 * MS)
            rig.state.x[CHAMBER] = 60.0
            if layer == "rig":
                rig.state.x[TUBE] = 60.0
            for n in range(1, 400):
                rig.state.x[CHAMBER] = 60.0
                if layer == "rig":
                    rig.state.x[TUBE] = 60.0
                advance(rig.params, rig.state, (4_000 + 10 * n) * MS)
            angles.append(rig.state.x[ANGLE])
        gaps.append(angles[1] - angles[0])
    assert gaps[0] == pytest.approx(0.0, abs=1e-3)
    assert 1.0 < gaps[1] < 8.0


def test_the_supply_is_constant_in_the_ideal_layer_only():
    for layer, moves in (("ideal", False), ("rig", True)):
        rig = Rig(layer=layer)
        before = rig.state.x[SUPPLY]
        rig.hold(200.0, 0.0, 0, 100 * MS)
        assert (abs(rig.state.x[SUPPLY] - before) > 1.0) == moves


@pytest.mark.parametrize("layer", ["ideal", "rig"])
def test_no_current_and_no_pressure_is_rest(layer):
    rig = Rig(layer=layer)
    rig.until(2_000 * MS)
    assert rig.state.x[ANGLE] == pytest.approx(rig.params.mechanics.rest_deg, abs=1e-9)
    assert rig.state.x[CHAMBER] == pytest.approx(0.0, abs=1e-9)
