import numpy as np
import pytest
from models import measured, values_of
from scipy.signal import lfilter

from softloop.offline.identification.coverage import true_values
from softloop.offline.identification.fitting import fit_output_error
from softloop.offline.identification.intervals import (
    BLOCKS_LEAST,
    _meat,
    _spectral_meat,
    autoregressive,
    between,
    blocks_of,
    bootstrap,
    information_rank,
    of_fit,
    period_of,
)
from softloop.offline.identification.output_error import Fit
from softloop.offline.identification.series import Series
from softloop.offline.identification.structure import PAPER


def test_an_autoregressive_process_is_found():
    noise = lfilter([1.0], [1.0, -0.9, 0.2], 0.3 * np.random.RandomState(1).standard_normal(20_000))
    coefficients, variance = autoregressive(noise)
    assert coefficients[:3] == pytest.approx([1.0, -0.9, 0.2], abs=0.05)
    assert variance == pytest.approx(0.09, rel=0.05)
    white, _ = autoregressive(np.random.RandomState(2).standard_normal(20_000))
    assert len(white) == 1


def test_coloured_covariance_is_what_repetition_shows_and_white_is_not():
    t = np.arange(4000) * 0.01
    columns = np.stack([np.sin(t), np.cos(0.7 * t)], axis=1)
    draws, claimed, naive = [], [], []
    for seed in range(150):
        error = lfilter([1.0], [1.0, -0.97], np.random.RandomState(seed).standard_normal(len(t)))
        gain = np.linalg.inv(columns.T @ columns)
        draws.append(gain @ columns.T @ error)
        claimed.append(np.diag(gain @ _meat(error, columns, "coloured") @ gain))
        naive.append(np.diag(gain @ _meat(error, columns, "white") @ gain))
    scatter = np.var(draws, axis=0)
    assert np.mean(claimed, axis=0) == pytest.approx(scatter, rel=0.35)
    assert (np.mean(naive, axis=0) < 0.2 * scatter).all()


def test_slow_noise_under_white_noise_is_seen_by_the_spectrum():
    t = np.arange(8000) * 0.01
    columns = np.stack([np.sin(0.5 * t), np.cos(1.3 * t), np.ones_like(t)], axis=1)
    gain = np.linalg.inv(columns.T @ columns)
    draws, claimed, few_terms = [], [], []
    for seed in range(200):
        random = np.random.RandomState(seed)
        error = lfilter([0.02], [1.0, -0.98], random.standard_normal(len(t))) + 0.5 * random.standard_normal(len(t))
        draws.append(gain @ columns.T @ error)
        left = error - columns @ draws[-1]  # what a fit leaves
        claimed.append(np.diag(gain @ _spectral_meat(left, columns, gain) @ gain))
        few_terms.append(np.diag(gain @ _meat(left, columns, "coloured") @ gain))
    scatter = np.var(draws, axis=0)
    assert np.mean(claimed, axis=0) == pytest.approx(scatter, rel=0.25)
    assert (np.mean(few_terms, axis=0) < 0.8 * scatter).all()


def test_spectrum_of_white_noise_gives_the_textbooks_covariance_of_any_length():
    for n in (7, 60, 4001):
        columns = np.random.RandomState(3).standard_normal((n, 2))
        found = _spectral_meat(np.random.RandomState(4).standard_normal(n), columns, np.linalg.inv(columns.T @ columns))
        assert np.linalg.eigvalsh(found).min() > 0.0
        if n > 1000:
            assert found == pytest.approx(_meat(np.random.RandomState(4).standard_normal(n), columns, "white"), rel=0.1, abs=60.0)


def test_intervals_of_an_output_error_fit_hold_true_values():
    held = []
    for seed in range(12):
        data = measured(PAPER, values_of(PAPER), seed=seed, seconds=25.0, noise_deg=0.1)
        low, high = of_fit(fit_output_error(PAPER, [data]), [data], "coloured").interval()
        held.append((low <= true_values()) & (true_values() <= high))
    assert np.mean(held) > 0.85


def test_bootstrap_of_independent_blocks_is_what_repetition_shows():
    t = np.arange(6000) * 0.01
    columns = np.stack([np.sin(0.5 * t), np.cos(1.3 * t), np.ones_like(t), t / 60.0, np.zeros_like(t)], axis=1)
    blocks = [np.array_split(np.arange(len(t)), 6)]
    gain, draws, claimed = np.linalg.pinv(columns.T @ columns), [], []
    for seed in range(300):
        error = lfilter([0.05], [1.0, -0.95], np.random.RandomState(seed).standard_normal(len(t)))
        draws.append(gain @ columns.T @ error)
        covariance, degrees = bootstrap([error - columns @ draws[-1]], [columns], blocks)
        assert degrees == 5.0
        claimed.append(np.diag(covariance))
    scatter = np.var(draws, axis=0)
    assert np.mean(claimed, axis=0)[:4] == pytest.approx(scatter[:4], rel=0.3)
    assert np.mean(claimed, axis=0)[4] == 0.0


def test_bootstrap_of_a_fit_is_of_the_size_of_the_others():
    data = measured(PAPER, values_of(PAPER), seconds=80.0, noise_deg=0.1)
    fit = fit_output_error(PAPER, [data])
    found = of_fit(fit, [data], "bootstrap")
    assert found.degrees == BLOCKS_LEAST - 1
    ratio = found.errors / of_fit(fit, [data], "white").errors
    assert ((ratio > 0.2) & (ratio < 5.0)).all()


@pytest.mark.parametrize("inputs", [1, 2])
def test_a_pressure_that_repeats_itself_has_a_period(inputs):
    time_s = np.arange(0.0, 70.0, 0.01) + 0.001 * np.random.RandomState(1).uniform(-1.0, 1.0, 7000)
    random = np.random.RandomState(2)
    waves = [sum(np.cos(0.1 * np.pi * k * time_s + random.uniform(0.0, 7.0)) for k in range(1, 11)) for _ in range(inputs)]
    noise = 0.05 * random.standard_normal((7000, inputs))
    assert period_of(time_s, 40.0 + np.stack(waves, axis=1) + noise) == pytest.approx(20.0, abs=0.05)
    half = time_s < 35.0  # not once more, whole
    assert period_of(time_s[half], np.stack(waves, axis=1)[half]) is None
    assert period_of(time_s, np.cumsum(random.standard_normal((7000, inputs)), axis=0)) is None
    assert period_of(time_s, np.full((7000, inputs), 30.0)) is None


def test_blocks_are_whole_and_the_same_place_of_a_period_is_one_block():
    t = np.arange(0.0, 60.0, 0.01)
    wave = sum(np.cos(0.1 * np.pi * k * t + k * k) for k in range(1, 9))
    for pressure, count in ((wave, BLOCKS_LEAST), (np.sin(t**1.5 / 5.0), 5)):
        series = Series("t", t, pressure[:, None], t, (5.0, 59.0))
        blocks = blocks_of(series)
        assert len(blocks) == count
        assert np.concatenate(blocks).size == series.counted.sum()
        assert len(np.unique(np.concatenate(blocks))) == series.counted.sum()
    place = t[blocks_of(Series("t", t, wave[:, None], t))[1]] % 20.0
    assert place.min() == pytest.approx(5.0, abs=0.05)
    assert place.max() == pytest.approx(10.0, abs=0.05)


def test_several_experiments_give_mean_and_spread():
    values = np.array([[1.0, 2.0], [3.0, 2.0], [2.0, 2.0]])
    fits = []
    for row in values:
        full = np.zeros(PAPER.size)
        full[:2] = row
        fits.append(Fit(PAPER, full, np.zeros((1, 2)), (0.0,)))
    found = between(fits)
    assert found.values[:2].tolist() == [2.0, 2.0]
    assert found.errors[:2] == pytest.approx([1.0 / np.sqrt(3.0), 0.0])
    assert found.degrees == 2.0


def test_rank_says_what_cannot_be_told_apart():
    column = np.random.RandomState(3).standard_normal((100, 1))
    rank, relative = information_rank(np.hstack([column, 1e6 * column, np.ones((100, 1))]))
    assert rank == 2
    assert relative[0] == 1.0
