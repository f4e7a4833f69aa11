"""The law of the flow tests: the plan's currents as they are, inside two limits of the pressure."""

import numpy as np
import pytest

from softloop.controller import records as r
from softloop.controller.laws.valve_test import valve_test_step
from softloop.wire.kernel import new_record


@pytest.fixture
def step():
    """A function of current and chamber pressure that takes one step and returns (charge, exhaust, mode)."""
    gains, state = new_record(r.GAINS), np.zeros(1, r.CONTROLLER_STATE)[0]
    gains.valve_test.top_kpa, gains.valve_test.low_kpa = 100.0, 5.0
    state.mode = r.MODE_HOLD
    demand = new_record(r.DEMAND)

    def once(current_ma, chamber_kpa):
        measurement, reference = new_record(r.MEASUREMENT), new_record(r.REFERENCE)
        measurement.chamber_kpa, reference.value = chamber_kpa, current_ma
        valve_test_step(measurement, reference, gains, state, demand)
        assert demand.mode == state.mode
        return float(state.charge_ma), float(state.exhaust_ma), int(state.mode)

    return once


def test_one_valve_gets_the_plans_current(step):
    assert step(120.0, 50.0) == (120.0, 0.0, r.MODE_CHARGE)
    assert step(-80.0, 50.0) == (0.0, 80.0, r.MODE_EXHAUST)
    assert step(0.0, 50.0) == (0.0, 0.0, r.MODE_HOLD)


@pytest.mark.parametrize(("current", "outside", "near", "inside"), [(120.0, 100.5, 98.0, 96.0), (-80.0, 4.0, 7.0, 9.0)])
def test_at_a_limit_it_shuts_and_opens_again_only_well_inside(step, current, outside, near, inside):
    assert step(current, near)[2] == r.MODE_HOLD  # from rest so near the limit it does not begin
    assert step(current, inside)[2] != r.MODE_HOLD
    assert step(current, near)[2] != r.MODE_HOLD
    assert step(current, outside) == (0.0, 0.0, r.MODE_HOLD)
    assert step(current, near)[2] == r.MODE_HOLD
    assert step(current, inside)[2] != r.MODE_HOLD
