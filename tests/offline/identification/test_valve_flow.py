import numpy as np
import pytest

from softloop.dynamics.parameters import load_parameters, shipped
from softloop.offline.identification.valve_flow import FlowTests, fit_valve, modelled
from softloop.wire.errors import BadFile

TRUE = np.array([5.0e-9, 5.0e-7, 5.0e-13, 3.0e-7, 0.5])


def flow_tests(supplies_kpa, downstreams_kpa, noise=0.0, seed=1):
    grid = np.meshgrid(np.arange(60.0, 180.0, 6.0), supplies_kpa, downstreams_kpa)
    current, up, down = (g.ravel() for g in grid)
    keep = up > down
    blank = FlowTests(current[keep], up[keep], down[keep], np.zeros(keep.sum()))
    flow = modelled(TRUE, blank, 0.8, 293.15)
    flow += noise * flow.max() * np.random.RandomState(seed).standard_normal(len(flow))
    return FlowTests(blank.current_ma, blank.upstream_kpa, blank.downstream_kpa, np.maximum(flow, 0.0))


def test_five_numbers_come_back_and_give_six_coefficients():
    found = fit_valve(flow_tests((100.0, 150.0, 200.0), (0.0, 50.0, 90.0)), 0.8)
    assert found.rank == 5
    assert found.fit > 99.9
    assert found.values == pytest.approx(TRUE, rel=0.02)
    six, shipped_valve = found.coefficients(), load_parameters(shipped()).charge
    assert six["k_v2"] / six["k_v4"] == pytest.approx(six["k_v3"] / six["k_v5"])
    assert six["k_v4"] == pytest.approx(shipped_valve.k_v4_pa, rel=0.03)
    assert six["k_v5"] == pytest.approx(shipped_valve.k_v5_m2_pa, rel=0.03)


def test_intervals_hold_the_true_numbers_of_noisy_tests():
    held = []
    for seed in range(10):
        sure = fit_valve(flow_tests((100.0, 150.0, 200.0), (0.0, 50.0, 90.0), 0.005, seed), 0.8).uncertainty
        low, high = sure.interval()
        held.append((low <= TRUE) & (high >= TRUE))
    assert np.mean(held) > 0.8


def test_one_pressure_says_nothing_of_the_flow_force_and_no_number_is_given():
    found = fit_valve(flow_tests((200.0,), (0.0,)), 0.8)
    assert found.fit > 99.0
    assert found.rank < 5
    assert found.uncertainty is None


def test_too_few_tests_are_refused():
    few = FlowTests(*(np.ones(4) for _ in range(4)))
    with pytest.raises(BadFile, match="4 flow tests"):
        fit_valve(few)


def test_what_the_tests_show_has_a_number_and_what_they_do_not_has_none():
    found = fit_valve(flow_tests((60.0, 100.0, 150.0, 200.0), (0.0,)), 0.8)
    assert found.rank == 4
    assert found.shown == ("k_v1_m2_ma", "k_v2_pa", "k_v3_m2_pa", "k_v6_m2")
    assert found.uncertainty.values == pytest.approx(TRUE[:4], rel=0.03)
    assert found.uncertainty.covariance.shape == (4, 4)
