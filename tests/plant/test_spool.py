import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.dynamics.valve import orifice_area
from softloop.plant.physics import advance, play, settle_inputs, slip_s
from softloop.plant.records import AREA_IN, AREA_OUT, SPEED_IN, SPEED_OUT, SUPPLY, TUBE
from softloop.plant.spool import crossing, turn
from tests.plant.rigs import MS, Rig

UNIT = st.floats(-1.0, 1.0)
LIMIT_M2 = 5e-12


@given(UNIT, UNIT, UNIT, UNIT)
def test_crossing_finds_the_root_of_the_cubic(start, start_slope, end, end_slope):
    if start * end >= -1e-6:
        return
    s = crossing(start, start_slope, end, end_slope)
    basis = np.array([2 * s**3 - 3 * s**2 + 1, s**3 - 2 * s**2 + s, -2 * s**3 + 3 * s**2, s**3 - s**2])
    assert basis @ (start, start_slope, end, end_slope) == pytest.approx(0.0, abs=1e-6)


@given(UNIT, UNIT, UNIT)
def test_turn_finds_the_root_of_the_parabola(before, middle, after):
    s = turn(before, middle, after)
    assert 0.0 < s <= 1.0
    if before * after >= -1e-6:
        return
    at_s = before * (1.0 - s) * (1.0 - 2.0 * s) + 4.0 * middle * s * (1.0 - s) + after * s * (2.0 * s - 1.0)
    assert s == 1.0 or at_s == pytest.approx(0.0, abs=1e-9)


def areas_through_a_change(step_us, start, end):
    """Areas each 1 ms after currents that both plays have followed change to `end`; shape (5, 2)."""
    rig, found = Rig(seed=3, step_us=step_us), []
    rig.hold(*start, 0, 100 * MS)
    rig.state.command_charge_ma, rig.state.command_exhaust_ma = end
    settle_inputs(rig.params, rig.state)
    for _ in range(5):
        advance(rig.params, rig.state, rig.state.t_ns + MS)
        found.append((rig.state.x[AREA_IN], rig.state.x[AREA_OUT]))
    return np.array(found)


@pytest.mark.parametrize("exhaust_ma", np.linspace(75.0, 200.0, 12).tolist())
def test_when_both_plays_slip_and_a_spool_leaves_its_seat_the_areas_stay_as_exact(exhaust_ma):
    changes = ((85.0, 54.0), (61.0, exhaust_ma)), ((61.0, exhaust_ma), (95.0, 54.0))
    for start, end in changes:
        coarse, fine = areas_through_a_change(500, start, end), areas_through_a_change(10, start, end)
        assert np.abs(coarse - fine).max() < LIMIT_M2
        assert np.ptp(fine, axis=0).max() > 1e-8


def test_a_spool_comes_to_rest_where_equation_16_says():
    rig = Rig(seed=3)
    rig.params.air.play_charge_ma = rig.params.air.play_exhaust_ma = 0.0
    rig.hold(90.0, 95.0, 0, 200 * MS)
    x, air = rig.state.x, rig.params.air
    supply_pa, block_pa = 1e3 * x[SUPPLY], 1e3 * x[TUBE]
    area_in = orifice_area(air.charge, air.k_v1_charge, air.k_v6_charge, 90.0, supply_pa, block_pa)
    area_out = orifice_area(air.exhaust, air.k_v1_exhaust, air.k_v6_exhaust, 95.0, block_pa, 0.0)
    assert x[AREA_IN] == pytest.approx(area_in, rel=1e-3)
    assert x[AREA_OUT] == pytest.approx(area_out, rel=1e-3)
    assert x[AREA_IN] > 1e-8
    assert x[AREA_OUT] > 1e-8


@given(st.lists(st.tuples(st.floats(0.0, 220.0), st.floats(0.0, 220.0)), min_size=1, max_size=8), st.integers(0, 5))
def test_spools_stay_in_their_stroke_and_stop_at_its_ends(currents, seed):
    rig = Rig(seed=seed)
    end = rig.params.air.charge.area_max_m2
    for n, (charge, exhaust) in enumerate(currents):
        rig.command(charge, exhaust, n * 5 * MS + 270_000)
        for _ in range(5):
            advance(rig.params, rig.state, rig.state.t_ns + MS)
            for place, speed in ((AREA_IN, SPEED_IN), (AREA_OUT, SPEED_OUT)):
                assert 0.0 <= rig.state.x[place] <= end
                if rig.state.x[place] == 0.0:
                    assert rig.state.x[speed] >= 0.0
        rig.until((n + 1) * 5 * MS)


@given(st.lists(st.floats(0.0, 220.0), min_size=1, max_size=20), st.floats(0.0, 11.0))
def test_play_keeps_within_its_width_and_moves_only_when_pushed(currents, half_width):
    held = 0.0
    for current in currents:
        moved = play(current, held, half_width)
        assert abs(moved - current) <= half_width + 1e-12
        assert moved == held or abs(abs(moved - current) - half_width) < 1e-9
        held = moved


def test_slip_is_when_the_transient_reaches_the_edge():
    at_s = slip_s(0.0, 100.0, 0.0, 8.0, 1.5e-3)  # rises from 0; the edge is 8 mA above what is held
    assert 100.0 * (1.0 - np.exp(-at_s / 1.5e-3)) == pytest.approx(8.0)
    assert slip_s(0.0, 5.0, 0.0, 8.0, 1.5e-3) == np.inf  # never gets there
    assert slip_s(50.0, 100.0, 42.0, 8.0, 1.5e-3) == np.inf  # slips from the start
    falling = slip_s(100.0, 0.0, 92.0, 8.0, 1.5e-3)
    assert 100.0 * np.exp(-falling / 1.5e-3) == pytest.approx(84.0)
