import numpy as np
import pytest
from models import measured, values_of

from softloop.offline.identification.fitting import fit_output_error, start, start_linear
from softloop.offline.identification.output_error import Problem, score, solve
from softloop.offline.identification.series import Series
from softloop.offline.identification.simulator import simulate
from softloop.offline.identification.structure import LINEAR, PAPER, Structure


def test_the_true_values_come_back_from_clean_data():
    values = values_of(PAPER)
    fit = fit_output_error(PAPER, [measured(PAPER, values)])
    assert fit.fits[0] > 99.99
    assert fit.values[:5] == pytest.approx(values[:5], rel=2e-2)
    assert score(fit, measured(PAPER, values, seed=7)) > 99.99


def test_memory_lag_and_delay_come_back():
    structure = Structure(hysteresis=1, creep=1, delay=True)
    values = values_of(structure, h1=250.0, w1=12.0, k1=9.0, rate1=0.4, delay_s=0.02)
    fit = fit_output_error(structure, [measured(structure, values, noise_deg=0.02)], iterations=100)
    found = fit.named()
    assert fit.fits[0] > 99.8
    assert found["delay_s"] == pytest.approx(0.02, abs=2e-3)
    assert found["h1"] == pytest.approx(250.0, rel=0.15)
    assert found["rate1"] == pytest.approx(0.4, rel=0.2)
    unseen = measured(structure, values, seed=5)
    without = fit_output_error(PAPER, [measured(structure, values, noise_deg=0.02)])
    assert score(fit, unseen) > 99.5 > score(without, unseen)


def test_each_experiment_has_its_own_start_and_all_share_the_rest():
    values = values_of(PAPER)
    runs = [measured(PAPER, values, seed=s, seconds=20.0) for s in (1, 2)]
    fit = fit_output_error(PAPER, runs)
    assert fit.starts.shape == (2, 2)
    assert min(fit.fits) > 99.9


def test_the_jacobian_is_the_residuals_own():
    structure = Structure(hysteresis=1, creep=1, delay=True, lag=True)
    values = values_of(structure, h1=100.0, w1=8.0, k1=5.0, rate1=0.3, delay_s=0.012, lag_s=0.02)
    values[structure.place("c0")] = 0.2  # outside its bound, so that the bounds' rows are not all zero
    problem = Problem(structure, [measured(structure, values, seconds=5.0)])
    starts = np.array([[30.5, 1.0]])
    unknowns = problem.pack(values, starts)
    jacobian = problem.jacobian(unknowns, values)
    for i in range(len(unknowns)):
        step = np.zeros(len(unknowns))
        step[i] = 1e-5
        both = [problem.residuals(unknowns + sign * step, values) for sign in (1.0, -1.0)]
        numeric = (both[0] - both[1]) / 2e-5
        assert np.abs(jacobian[:, i] - numeric).max() <= 2e-2 * max(np.abs(numeric).max(), 1e-6), i


def test_a_first_state_before_the_window_is_that_of_the_first_samples():
    """What memory the model lacks must not end up in a first state that no other run has."""
    more = Structure(hysteresis=2, creep=2)
    values = values_of(more, h1=120.0, h2=80.0, w1=3.0, w2=20.0, k1=4.0, k2=4.0, rate1=0.05, rate2=0.6)
    train = measured(more, values, seconds=40.0, noise_deg=0.05, window_s=(6.0, 40.0))
    fit = fit_output_error(Structure(hysteresis=1, creep=1), [train])
    assert fit.starts[0, 0] == pytest.approx(train.angle_deg[0], abs=0.3)
    unseen = measured(more, values, seed=5, window_s=(6.0, 40.0))
    assert score(fit, unseen) > 97.0
    alone = Problem(PAPER, [train])
    values, starts = values_of(PAPER), np.array([[train.angle_deg[0] + 50.0, 0.0]])
    assert np.sum(alone.residuals(alone.pack(values, starts), values)[-2:] ** 2) > 1e3
    whole = Problem(PAPER, [measured(PAPER, values, seconds=5.0)])  # its first samples count themselves
    assert not whole.residuals(whole.pack(values, starts), values)[-2:].any()


def test_a_fit_stays_stable_on_and_beyond_its_range():
    noisy = measured(PAPER, values_of(PAPER), seconds=6.0, noise_deg=3.0)
    fit = fit_output_error(Structure(m=4, r=4), [noisy])
    poly = np.polynomial.polynomial.polyval
    low, high = noisy.angle_deg.min(), noisy.angle_deg.max()
    y = np.linspace(low, high, 50)
    assert (poly(y, fit.values[fit.structure.terms("a")]) > 0).all()
    assert (poly(y, fit.values[fit.structure.terms("c")]) > 0).all()


def test_linear_start_needs_no_other_and_a_good_regression_is_preferred():
    data = measured(PAPER, values_of(PAPER))
    linear = start_linear([data])
    assert linear.structure == LINEAR
    assert 80.0 < linear.fits[0] < 99.0
    assert start(PAPER, [data]).fits[0] > 99.0


def test_at_rest_every_run_has_its_own_zero():
    structure = Structure(m=0, r=0, at_rest=True)
    t = np.arange(0.0, 20.0, 0.01)
    pressure = np.where(t > 1.0, 40.0 * (1.0 - np.cos(t - 1.0)), 0.0)
    runs = []
    for zero in (0.0, 4.0):
        values, out = np.array([50.0, 40.0, 10.0, 0.0, zero, 0.0]), np.empty(len(t))
        simulate(values, structure.layout, t, pressure[:, None].copy(), 1, out)
        runs.append(Series(f"zero {zero}", t, pressure[:, None], out))
    fit = fit_output_error(structure, runs[:1])
    assert score(fit, runs[1]) > 99.9
    absolute = fit_output_error(Structure(m=0, r=0), runs[:1])
    assert score(absolute, runs[1]) < 95.0


def test_solving_from_the_answer_stays_there():
    values = values_of(PAPER)
    data = measured(PAPER, values, noise_deg=0.05)
    first = fit_output_error(PAPER, [data])
    again = solve(Problem(PAPER, [data]), first.values, first.starts)
    assert again.values[:5] == pytest.approx(first.values[:5], rel=1e-3)
