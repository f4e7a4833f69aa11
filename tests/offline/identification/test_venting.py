import numpy as np
import pytest

from softloop.dynamics.gas import ATMOSPHERE_PA, GAS_CONSTANT, mass_flux
from softloop.offline.identification.venting import WALL_K, Vent, fit_vent, rates, score_vent, simulated, vent_of
from softloop.wire.errors import BadFile

TRUE = np.array([1.0e-4, 0.03, 2.5])


def vent(first_kpa, noise_kpa=0.0, seed=1, seconds=40.0):
    t = np.arange(0.0, seconds, 0.02)
    clean = simulated(TRUE, Vent("", t, t), first_kpa)
    return Vent(f"{first_kpa} kPa", t, clean + noise_kpa * np.random.RandomState(seed).standard_normal(len(t)))


def test_a_fast_wall_is_eq_11():
    rate, _ = rates(np.array([1e-4, 0.0, 1e-6]), 60.0, 1.0)
    isothermal = -GAS_CONSTANT * WALL_K * 1e-4 * mass_flux(60_000.0 + ATMOSPHERE_PA, ATMOSPHERE_PA, WALL_K, 1.0) / 1000.0
    warm = simulated(np.array([1e-4, 0.0, 1e-3]), Vent("", np.arange(0.0, 1.0, 0.01), np.zeros(100)), 60.0)
    assert (warm[50] - warm[49]) / 0.01 == pytest.approx(isothermal, rel=0.15)
    assert rate == pytest.approx(1.4 * isothermal)  # before the wall has acted the gas is adiabatic


def test_the_flow_law_comes_back_and_simulates_another_pressure():
    found = fit_vent([vent(80.0, 0.05)])
    low, high = found.uncertainty.interval(0.999)
    assert ((low <= TRUE) & (high >= TRUE)).all()
    assert found.uncertainty.values == pytest.approx(TRUE, rel=0.05)
    assert score_vent(found.uncertainty.values, vent(40.0, 0.05, 2)) > 99.0


def test_the_volume_itself_is_not_identifiable():
    assert fit_vent([vent(80.0, 0.05), vent(30.0, 0.05, 2)]).rank == 3


def test_venting_begins_where_the_inflow_ends():
    t = np.arange(0.0, 10.0, 0.01)
    inflow = np.where(t < 4.0, 5.0, 0.0)
    assert vent_of("run", t, np.ones(1000), inflow).time_s[0] == pytest.approx(4.0)
    pressure = np.where(t < 4.0, 50.0, 50.0 * np.exp(-(t - 4.0)))
    assert vent_of("run", t, pressure).time_s[0] == pytest.approx(4.0, abs=0.05)
    with pytest.raises(BadFile, match="samples of venting"):
        vent_of("run", t, pressure, np.ones(1000))
