from math import sqrt

import numpy as np
import pytest

from softloop.plant.mismatch import draw

SEEDS = range(400)


def column(read):
    return np.array([read(draw(seed)) for seed in SEEDS])


@pytest.mark.parametrize(
    ("read", "low", "high"),
    [
        (lambda d: d.volume, 0.85, 1.15),
        (lambda d: d.leak, 0.3, 5.0),
        (lambda d: d.k_v1[0], 0.9, 1.1),
        (lambda d: d.k_v1[1], 0.9, 1.1),
        (lambda d: d.k_v6[0], 0.85, 1.15),
        (lambda d: d.k_v6[1], 0.85, 1.15),
        (lambda d: d.play_fraction[0], 0.05, 0.10),
        (lambda d: d.play_fraction[1], 0.05, 0.10),
        (lambda d: d.supply, 0.95, 1.05),
        (lambda d: d.supply_sensor[0], -0.0075, 0.0075),
        (lambda d: d.chamber_sensor[1], -0.0075, 0.0075),
        (lambda d: d.gyro_bias_deg_s, -0.5, 0.5),
        (lambda d: d.gyro_scale, 0.98, 1.02),
        (lambda d: d.clock_error, -1e-4, 1e-4),
        (lambda d: d.ambient_c, 10.0, 40.0),
        (lambda d: d.phases[2], 0.0, 1.0),
    ],
)
def test_each_draw_fills_its_range_and_stays_inside(read, low, high):
    drawn = column(read)
    assert drawn.min() >= low
    assert drawn.max() <= high
    assert drawn.min() < low + 0.03 * (high - low)
    assert drawn.max() > high - 0.03 * (high - low)


def test_the_leak_is_drawn_by_its_logarithm():
    assert np.median(column(lambda d: d.leak)) == pytest.approx(sqrt(0.3 * 5.0), rel=0.2)


def test_draws_do_not_hang_together():
    drawn = np.array([[d.volume, d.leak, *d.k_v1, *d.k_v6, d.supply, d.ambient_c, *d.theta_fraction] for d in map(draw, SEEDS)])
    correlation = np.corrcoef(drawn.T) - np.eye(drawn.shape[1])
    assert np.abs(correlation).max() < 0.2  # four standard errors


def test_a_seed_is_one_rig_for_good():
    assert draw(1) == draw(1)
    assert draw(1) != draw(2)
    # The table is fixed: results that name a seed must stay comparable.
    one = draw(1)
    found = (one.volume, one.leak, one.k_v1[0], one.play_fraction[1], one.ambient_c, one.theta_fraction[0])
    assert found == pytest.approx(ONE, rel=1e-12)


ONE = (0.8539261404321479, 3.909721216170884, 0.9951233484820697, 0.08963211913880936, 29.780435668160322, 0.7387458794880062)
