"""The box that the laws get: it holds what the covariance allows in every state, and is not wider than it must be."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from models import measured, values_of

from softloop.controller.laws.arc import mechanics_bound
from softloop.dynamics.parameters import load_parameters, model_record, shipped
from softloop.offline.identification.bounds import BOUND_ERRORS, bounds_of, half_widths, regressors, states_of
from softloop.offline.identification.fitting import fit_output_error
from softloop.offline.identification.intervals import of_fit
from softloop.offline.identification.structure import PAPER
from softloop.wire.errors import BadConfig


def spread(covariance, phi):
    return BOUND_ERRORS * np.sqrt(np.einsum("ni,ij,nj->n", phi, covariance, phi))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 6), st.floats(1e-3, 1.0))
def test_the_box_holds_every_state_and_lies_between_conditional_and_marginal(seed, count, own):
    random = np.random.RandomState(seed)
    mixed = random.standard_normal((count, count)) * 10.0 ** random.uniform(-4, 2, (count, 1))
    covariance = mixed @ mixed.T
    covariance += own * np.diag(np.diag(covariance))
    phi = random.standard_normal((50, count)) / np.sqrt(np.diag(covariance))
    found = half_widths(covariance, phi)
    marginal, alone = BOUND_ERRORS * np.sqrt(np.diag(covariance)), BOUND_ERRORS / np.sqrt(np.diag(np.linalg.inv(covariance)))
    assert (np.abs(phi) @ found >= (1.0 - 1e-6) * spread(covariance, phi)).all()
    assert (found <= (1.0 + 1e-9) * marginal).all()
    assert (found >= (1.0 - 1e-6) * alone).all()


def test_parameters_that_only_their_sum_is_known_of_get_the_width_of_the_sum():
    covariance = np.array([[1.0, -0.9999], [-0.9999, 1.0]])
    phi = np.stack([np.ones(9), np.linspace(0.9, 1.1, 9)], axis=1)
    found = half_widths(covariance, phi)
    assert found.sum() == pytest.approx(spread(covariance, phi).max(), rel=0.1)
    assert found.sum() < 0.06 * 2.0 * BOUND_ERRORS


def test_parameters_that_know_nothing_of_each_other_keep_the_papers_bounds_where_each_stands_alone():
    found = half_widths(np.diag([4.0, 9.0]), np.eye(2))
    assert found == pytest.approx([6.0, 9.0])


def test_the_regressors_are_those_of_the_law():
    angle, rate = np.array([60.0, 100.0]), np.array([-80.0, 150.0])
    bending = load_parameters(shipped()).bending
    half = np.array([0.5 * (getattr(bending, n).max - getattr(bending, n).min) for n in PAPER.names])
    model = model_record(load_parameters(shipped()))
    for row, y, v in zip(np.abs(regressors(angle, rate, np.zeros(2))), angle, rate, strict=True):
        assert 2.0 * row @ half == pytest.approx(mechanics_bound(model, y, v)[0], rel=1e-12)


def test_an_experiments_box_is_far_smaller_than_three_errors_of_each_alone():
    data = measured(PAPER, values_of(PAPER), seconds=40.0, noise_deg=0.1)
    sure = of_fit(fit_output_error(PAPER, [data]), [data], "coloured")
    phi, half = states_of(data), bounds_of(sure.covariance, data)
    assert (np.abs(phi) @ half >= (1.0 - 1e-6) * spread(sure.covariance, phi)).all()
    assert np.median((np.abs(phi) @ half) / (np.abs(phi) @ (BOUND_ERRORS * sure.errors))) < 0.3


def test_a_covariance_that_says_nothing_is_refused():
    with pytest.raises(BadConfig, match="not above 0"):
        half_widths(np.diag([1.0, 0.0]), np.ones((3, 2)))
    with pytest.raises(BadConfig, match="9 parameters"):
        bounds_of(np.eye(3), measured(PAPER, values_of(PAPER), seconds=5.0))
