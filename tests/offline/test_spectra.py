"""Residual, coherence, delay and gain of one signal against another."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softloop.offline.parity_bounds import EstimateConfig
from softloop.offline.spectra import chance, estimate

RATE_HZ = 200.0
TIME_S = np.arange(0.0, 30.0, 1.0 / RATE_HZ)
CONFIG = EstimateConfig(segment_s=6.0)


def tones(time_s, phases):
    return sum(np.sin(2 * np.pi * 0.1 * k * time_s + phase) for k, phase in enumerate(phases, 1))


def noise(seed, size=0.01):
    return np.random.default_rng(seed).normal(0.0, size, len(TIME_S))


@given(
    delay_ms=st.floats(-120.0, 120.0),
    gain=st.floats(0.3, 3.0),
    phases=st.lists(st.floats(0.0, 6.28), min_size=8, max_size=8),
    seed=st.integers(0, 2**31),
)
@settings(max_examples=40, deadline=None)
def test_delay_and_gain_are_found(delay_ms, gain, phases, seed):
    x = tones(TIME_S, phases) + noise(seed)
    y = gain * tones(TIME_S - 1e-3 * delay_ms, phases) + 5.0 + noise(seed + 1)
    found = estimate(x, y, RATE_HZ, CONFIG)
    assert found.delay_ms == pytest.approx(delay_ms, abs=0.6 + 0.01 * abs(delay_ms))
    assert found.gain == pytest.approx(gain, rel=0.05)
    assert found.coherence > 0.98
    assert found.residual_rms == pytest.approx(np.sqrt(np.mean((y - x) ** 2)))
    assert found.offset == pytest.approx(5.0, abs=0.2 + 0.2 * abs(gain - 1.0))


def test_unrelated_signals_have_neither_delay_nor_gain():
    found = [estimate(noise(seed, 1.0), noise(seed + 1000, 1.0), RATE_HZ, CONFIG) for seed in range(20)]
    assert np.median([one.coherence for one in found]) < chance(9)
    assert sum(one.delay_ms is None and one.gain is None for one in found) >= 15


@pytest.mark.parametrize("still", [np.zeros_like(TIME_S), np.full_like(TIME_S, 200.0)])
def test_a_signal_that_stands_still_has_a_residual_alone(still):
    moving = tones(TIME_S, [0.1, 0.2])
    for x, y in ((still, moving), (moving, still), (still, still)):
        found = estimate(x, y, RATE_HZ, CONFIG)
        assert (found.coherence, found.delay_ms, found.gain, found.low_hz) == (None, None, None, None)
        assert found.residual_max == pytest.approx(np.abs(y - x).max())


def test_the_excited_band_is_that_of_x():
    found = estimate(tones(TIME_S, [0.0] * 10) + noise(1), tones(TIME_S, [0.0] * 10), RATE_HZ, CONFIG)
    assert 0.05 < found.low_hz <= 0.2
    assert 1.0 <= found.high_hz < 1.5


def test_a_signal_shorter_than_a_segment_is_refused():
    with pytest.raises(ValueError, match="fewer than a segment"):
        estimate(TIME_S[:100], TIME_S[:100], RATE_HZ, CONFIG)
