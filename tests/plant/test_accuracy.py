"""A shorter version of `benchmarks/accuracy.py`."""

import pytest
from accuracy import IDEAL_LIMITS, RIG_LIMITS, errors, oracle_run, replay
from crude_tracking import track

from softloop.plant.config import PlantConfig

STEP_NS = 1000 * PlantConfig().step_us


def test_the_ideal_layer_against_scipy():
    currents = track("ideal", 6.0)
    angle, pressure = errors(replay("ideal", currents, STEP_NS), oracle_run(currents))
    assert angle < IDEAL_LIMITS[0]
    assert pressure < IDEAL_LIMITS[1]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_rig_layer_against_a_twentieth_of_the_step(seed):
    currents = track("rig", 10.0, seed)
    found, truth = (replay("rig", currents, step_ns, seed) for step_ns in (STEP_NS, STEP_NS // 20))
    angle, pressure = errors(found, truth)
    assert angle < RIG_LIMITS[0]
    assert pressure < RIG_LIMITS[1]
    assert truth[0].max() > 90.0  # the sequence moves it through its range
