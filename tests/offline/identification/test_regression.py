import numpy as np
import pytest
from models import measured, values_of

from softloop.offline.identification.coverage import true_values
from softloop.offline.identification.regression import as_fit, instrumental_variables, least_squares, low_pass
from softloop.offline.identification.structure import LINEAR, PAPER
from softloop.wire.errors import BadConfig


def test_filters_take_derivatives_of_what_is_slow():
    t = np.arange(0.0, 20.0, 0.005)
    hf, signal = low_pass(20.0), np.sin(t)
    late = t > 5.0
    h = 1.0 / (1.0 + 1j / 20.0) ** 3
    for derivative in (0, 1, 2):
        expected = np.imag(h * 1j**derivative * np.exp(1j * t))
        assert hf(signal, derivative, 0.005)[late] == pytest.approx(expected[late], abs=2e-5)


def test_least_squares_finds_clean_data_s_values():
    found = least_squares(PAPER, measured(PAPER, values_of(PAPER)))
    assert found.theta[[0, 1, 3, 4, 8]] == pytest.approx(true_values()[[0, 1, 3, 4, 8]], rel=5e-3)
    assert found.phi.shape == (len(found.error), 9)


def test_instruments_take_away_the_bias_of_noise():
    truth, errors = true_values(), {"ls": [], "iv": []}
    for seed in range(6):
        data = measured(PAPER, values_of(PAPER), seed=seed, noise_deg=2.0)
        errors["ls"].append(least_squares(PAPER, data, low_pass(60.0)).theta[3] / truth[3] - 1.0)
        errors["iv"].append(instrumental_variables(PAPER, data, truth).theta[3] / truth[3] - 1.0)
    assert abs(np.mean(errors["iv"])) < 0.003 < abs(np.mean(errors["ls"]))


def test_a_regression_is_a_model_that_can_be_simulated():
    data = measured(PAPER, values_of(PAPER))
    assert as_fit(least_squares(PAPER, data), data).fits[0] > 99.0
    assert as_fit(least_squares(LINEAR, data), data).fits[0] > 80.0


def test_too_short_a_series_is_refused_and_so_is_a_start_that_explodes():
    with pytest.raises(BadConfig, match="too few for 11 values"):
        least_squares(PAPER, measured(PAPER, values_of(PAPER), seconds=0.7))
    start = true_values()
    start[4] = -50.0
    with pytest.raises(BadConfig, match="stable"):
        instrumental_variables(PAPER, measured(PAPER, values_of(PAPER)), start)
