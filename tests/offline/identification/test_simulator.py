import numpy as np
import pytest
from models import measured, values_of
from scipy.integrate import solve_ivp

from softloop.offline.identification.simulator import LIMIT, delayed, friction, simulate
from softloop.offline.identification.structure import PAPER, Structure, carry_over, d_at_rest


def test_eq_2_as_an_adaptive_solver_has_it():
    values = values_of(PAPER)
    series = measured(PAPER, values, seconds=6.0)
    begin = [series.angle_deg[0], 0.0]
    a, b, c, d = values[:3], values[3], values[4:8], values[8]
    poly = np.polynomial.polynomial.polyval

    def rates(t, x):
        pressure = np.interp(t, series.time_s, series.pressure_kpa[:, 0])
        return [x[1], -poly(x[0], a) * x[0] - poly(x[0], c) * x[1] + b * pressure + d]

    oracle = solve_ivp(rates, (0.0, series.time_s[-1]), begin, "DOP853", series.time_s, rtol=1e-9, atol=1e-9, max_step=0.005)
    assert np.abs(oracle.y[0] - series.angle_deg).max() < 3e-4  # the oracle's steps do not know the pressure's kinks


def test_memory_as_an_adaptive_solver_has_it():
    structure = Structure(hysteresis=1, creep=1, lag=True)
    values = values_of(structure, h1=200.0, w1=10.0, k1=8.0, rate1=0.5, lag_s=0.03)
    series = measured(structure, values, seconds=4.0)
    theta, poly = values_of(PAPER), np.polynomial.polynomial.polyval

    def rates(t, x):
        y, v, z, creep, seen = x
        force = theta[3] * np.interp(t, series.time_s, series.pressure_kpa[:, 0]) + theta[8] - 200.0 * z - 8.0 * (y - creep)
        hysteresis = v / 10.0 * (1.0 - np.sign(v) * z)
        acceleration = force - poly(y, theta[:3]) * y - poly(y, theta[4:8]) * v
        return [v, acceleration, hysteresis, 0.5 * (y - creep), (y - seen) / 0.03]

    begin = [series.angle_deg[0], 0.0, 0.0, series.angle_deg[0], series.angle_deg[0]]
    oracle = solve_ivp(rates, (0.0, series.time_s[-1]), begin, "RK45", series.time_s, rtol=1e-8, atol=1e-8, max_step=0.001)
    assert np.abs(oracle.y[4] - series.angle_deg).max() < 5e-3


def test_friction_is_bounded_and_turns():
    z = 0.0
    for moved in (5.0, 500.0, -1.0, -500.0, 3.0):
        z = friction(z, moved, 10.0)
        assert -1.0 <= z <= 1.0
    assert friction(0.3, 0.0, 10.0) == 0.3
    assert friction(0.0, 2.0, 10.0) == pytest.approx(-friction(0.0, -2.0, 10.0))
    assert friction(friction(0.1, 2.0, 10.0), 3.0, 10.0) == pytest.approx(friction(0.1, 5.0, 10.0))


def test_a_delay_shifts_and_may_be_negative():
    t = np.array([0.0, 1.0, 2.0, 4.0])
    pressure, out = np.array([[0.0], [10.0], [20.0], [40.0]]), np.empty((4, 1))
    for delay, expected in ((0.5, (0, 5, 15, 35)), (-0.5, (5, 15, 25, 40)), (9.0, (0, 0, 0, 0))):
        delayed(t, pressure, delay, out)
        assert out[:, 0] == pytest.approx(expected)


def test_a_model_that_explodes_stays_finite():
    values = values_of(PAPER)
    values[4] = -30.0
    series = measured(PAPER, values, seconds=4.0)
    assert np.isfinite(series.angle_deg).all()
    assert series.angle_deg[-1] == LIMIT


def test_at_rest_nothing_moves_whatever_the_zero():
    structure = Structure(at_rest=True, hysteresis=1, creep=1, inputs=2)
    values = np.zeros(structure.size)
    for name, value in {
        "a0": 90.0,
        "b0_p1": 60.0,
        "b0_p2": -50.0,
        "c0": 15.0,
        "h1": 50.0,
        "w1": 5.0,
        "k1": 4.0,
        "rate1": 0.2,
    }.items():
        values[structure.place(name)] = value
    values[-2] = 12.5
    t, out = np.arange(0.0, 3.0, 0.01), np.empty(300)
    pressure = np.tile([3.0, 7.0], (300, 1))
    simulate(values, structure.layout, t, pressure, 1, out)
    assert out == pytest.approx(12.5)
    assert d_at_rest(structure, values, pressure[0]) == pytest.approx(90.0 * 12.5 - 180.0 + 350.0)


def test_carrying_over_keeps_names():
    small, large = Structure(m=1), Structure(m=3, n=1, r=3, hysteresis=2, delay=True)
    values = np.arange(1.0, small.size + 1)
    moved = carry_over(values, small, large)
    assert [moved[large.place(n)] for n in small.names] == values[:-2].tolist()
    assert moved[large.place("a3")] == 0.0
    assert len(large.names) == len(set(large.names)) == large.size - 2
    assert len(large.scales(100.0, 100.0)) == large.size
