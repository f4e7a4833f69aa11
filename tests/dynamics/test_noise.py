import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.dynamics.noise import gaussian, splitmix64, uniform

WORD = st.integers(0, 2**64 - 1)
INDEX = st.integers(0, 2**40)


def reference_splitmix64(state):
    mask = 2**64 - 1
    z = state + 0x9E3779B97F4A7C15 & mask
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9 & mask
    z = (z ^ z >> 27) * 0x94D049BB133111EB & mask
    return z ^ z >> 31


@given(WORD)
def test_splitmix64_is_the_published_one(state):
    assert int(splitmix64(np.uint64(state))) == reference_splitmix64(state)


def test_the_known_first_output():
    assert int(splitmix64(np.uint64(0))) == 0xE220A8397B1DCDAF


@given(INDEX, INDEX, INDEX)
def test_uniform_is_in_its_range_and_gaussian_is_finite(seed, device, sample):
    assert 0.0 < uniform(seed, device, sample) <= 1.0
    assert abs(gaussian(seed, device, sample)) < 9.0


@given(INDEX, INDEX, INDEX)
def test_the_plain_function_gives_the_same_bits(seed, device, sample):
    assert getattr(gaussian, "py_func", gaussian)(seed, device, sample) == gaussian(seed, device, sample)


def test_gaussian_has_its_moments_and_no_memory():
    x = np.array([gaussian(3, 1, n) for n in range(40_000)])
    assert x.mean() == pytest.approx(0.0, abs=0.02)  # four standard errors
    assert x.std() == pytest.approx(1.0, abs=0.015)
    assert (x**3).mean() == pytest.approx(0.0, abs=0.08)
    assert (x**4).mean() == pytest.approx(3.0, abs=0.2)
    for lag in (1, 2, 7):
        assert (x[lag:] * x[:-lag]).mean() == pytest.approx(0.0, abs=0.02)


def test_seeds_and_devices_are_strangers_to_each_other():
    draws = [np.array([gaussian(seed, device, n) for n in range(10_000)]) for seed, device in ((1, 1), (1, 2), (2, 1))]
    for i in range(3):
        for j in range(i):
            assert np.corrcoef(draws[i], draws[j])[0, 1] == pytest.approx(0.0, abs=0.04)
