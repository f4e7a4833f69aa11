import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.dynamics.bending import bending_acceleration
from softloop.dynamics.parameters import load_parameters, shipped
from softloop.plant.mechanics import acceleration, advance_memory, creep, hysteresis, load
from softloop.plant.parameters import HYSTERESIS_DEG_S2, draw_rig
from softloop.plant.records import MEMORY
from softloop.wire.kernel import new_record

PARAMETERS = load_parameters(shipped())
RIG = draw_rig("rig", 1, PARAMETERS).mechanics
IDEAL = draw_rig("ideal", 1, PARAMETERS).mechanics
ANGLE = st.floats(0.0, 180.0)


def relaxed(angle_deg=60.0):
    memory = new_record(MEMORY)
    memory.angle_deg, memory.inertia = angle_deg, 1.0
    return memory


def walk(memory, path):
    """Force along a path of angles."""
    force = []
    for angle in path:
        advance_memory(RIG, memory, angle)
        force.append(hysteresis(RIG, memory, angle))
    return np.array(force)


@given(st.lists(ANGLE, min_size=1, max_size=30))
def test_hysteresis_is_bounded(path):
    assert np.abs(walk(relaxed(), path)).max() <= HYSTERESIS_DEG_S2 * (1.0 + 1e-12)


@given(ANGLE, ANGLE)
def test_one_way_needs_no_steps_between(start, end):
    direct, stepped = relaxed(start), relaxed(start)
    advance_memory(RIG, direct, end)
    walk(stepped, np.linspace(start, end, 57))
    assert stepped.stop == pytest.approx(direct.stop, abs=1e-9)
    assert hysteresis(RIG, relaxed(start), end) == pytest.approx(hysteresis(RIG, direct, end), abs=1e-9)


@given(st.lists(ANGLE, min_size=2, max_size=12))
def test_a_closed_path_only_takes_energy(corners):
    """The second turn begins and ends in the same memory, so that nothing is stored."""
    path = np.concatenate([np.linspace(a, b, 60) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)])
    memory = relaxed(path[0])
    walk(memory, path)
    before = memory.stop.copy()
    force = walk(memory, path)
    if np.allclose(before, memory.stop, atol=1e-9):
        work = -np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(path))
        assert work >= -0.02 * HYSTERESIS_DEG_S2  # the sum's own error


def test_a_wide_loop_takes_what_its_area_says():
    memory = relaxed(40.0)
    path = np.concatenate((np.linspace(40.0, 140.0, 4001), np.linspace(140.0, 40.0, 4001)))
    walk(memory, path)
    force = walk(memory, path)
    work = -np.sum(0.5 * (force[1:] + force[:-1]) * np.diff(path))
    # A stop of stiffness k and width r takes 4 k r (A - r) on a loop of half amplitude A.
    expected = np.sum(4.0 * RIG.stop_stiffness * RIG.stop_deg * (50.0 - RIG.stop_deg))
    assert work == pytest.approx(expected, rel=1e-3)


@given(ANGLE, st.floats(-200.0, 200.0), st.floats(0.0, 150.0))
def test_relaxed_and_unloaded_it_is_equation_2(angle, rate, pressure):
    memory = relaxed(angle)
    assert acceleration(RIG, memory, angle, rate, pressure, angle, angle, angle) == bending_acceleration(
        RIG.theta, angle, rate, pressure
    )
    assert acceleration(IDEAL, relaxed(0.0), angle, rate, pressure, 0.0, 0.0, 0.0) == bending_acceleration(
        IDEAL.theta, angle, rate, pressure
    )


def test_creep_pulls_back_to_where_it_has_been():
    assert creep(RIG, 90.0, 60.0, 60.0, 60.0) == pytest.approx(-30.0 * RIG.creep_stiffness.sum())
    assert creep(RIG, 90.0, 90.0, 90.0, 90.0) == 0.0


def test_payload_pulls_by_its_sine_and_makes_heavier():
    memory = relaxed()
    memory.payload_deg_s2, memory.inertia = 400.0, 1.25
    assert load(RIG, memory, 90.0, 0.0) == pytest.approx(-400.0)
    assert load(RIG, memory, 30.0, 0.0) == pytest.approx(-200.0)
    with_load = acceleration(RIG, memory, 60.0, 0.0, 50.0, 60.0, 60.0, 60.0)
    without = acceleration(RIG, relaxed(), 60.0, 0.0, 50.0, 60.0, 60.0, 60.0)
    assert with_load == pytest.approx((without - 400.0 * np.sin(np.pi / 3.0)) / 1.25)


@given(ANGLE, st.floats(-500.0, 500.0))
def test_contact_only_pushes(angle, rate):
    memory = relaxed()
    memory.contact_1_s2, memory.contact_deg = 500.0, 80.0
    force = load(RIG, memory, angle, rate)
    assert force <= 0.0
    if angle <= 80.0:
        assert force == 0.0
    elif rate >= 0.0:
        assert force <= -500.0 * (angle - 80.0)
