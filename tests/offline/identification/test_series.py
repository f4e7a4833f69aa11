import numpy as np
import pytest

from softloop.controller.records import CYCLE
from softloop.offline.identification.experiments import FAST, excite, halves
from softloop.offline.identification.series import Series, between_samples, from_cycles, nrmse_fit
from softloop.plant.config import PlantConfig
from softloop.wire.errors import BadFile


def test_fit_is_the_paper_s():
    y = np.array([1.0, 2.0, 3.0, 4.0])
    assert nrmse_fit(y, y) == 100.0
    assert nrmse_fit(y, np.full(4, 2.5)) == pytest.approx(0.0)
    assert nrmse_fit(y, y + 1.0) == pytest.approx(100.0 * (1.0 - 2.0 / np.sqrt(5.0)))


def test_halves_share_no_sample_and_the_second_keeps_the_first_s_past():
    t = np.arange(0.0, 10.0, 0.01)
    run = Series("run", t, t[:, None], np.sin(t), (2.0, 8.0))
    first, second = halves(run)
    assert not (first.counted[: len(first.time_s)] & second.counted[: len(first.time_s)]).any()
    assert first.counted.sum() + second.counted.sum() == run.counted.sum()
    assert second.time_s[0] == 0.0


def test_even_series_hold_the_window_only():
    t = np.sort(np.random.RandomState(1).uniform(0.0, 10.0, 2000))
    even = Series("run", t, np.stack([t, 2 * t], axis=1), 3 * t, (2.0, 8.0)).uniform()
    assert np.ptp(np.diff(even.time_s)) < 1e-9
    assert even.time_s[0] >= 2.0
    assert even.angle_deg == pytest.approx(3 * even.time_s)
    assert even.pressure_kpa[:, 1] == pytest.approx(2 * even.time_s)


def test_between_samples_a_curve_is_a_curve_and_where_one_is_missing_straight():
    at_s, wanted = np.arange(0.0, 2.0, 0.005), np.arange(0.001, 1.99, 0.0037)
    wave, exact = np.sin(6.0 * at_s), np.sin(6.0 * wanted)
    inside = (wanted > 0.005) & (wanted < 1.985)  # four samples around it
    curved, straight = between_samples(wanted, at_s, wave), np.interp(wanted, at_s, wave)
    assert np.abs(curved - exact)[inside].max() < 1e-7 < 1e-5 < np.abs(straight - exact)[inside].max()
    assert between_samples(at_s, at_s, wave) == pytest.approx(wave, abs=1e-15)
    assert between_samples(wanted, at_s, 3.0 - 2.0 * at_s) == pytest.approx(3.0 - 2.0 * wanted)
    lost = np.delete(np.arange(len(at_s)), [100, 101])
    near = (wanted > at_s[99]) & (wanted < at_s[102])
    assert (between_samples(wanted, at_s[lost], wave[lost])[near] == np.interp(wanted, at_s[lost], wave[lost])[near]).all()
    few = between_samples(np.array([0.0, 0.5, 1.0]), np.array([0.0, 1.0]), np.array([2.0, 4.0]))
    assert few.tolist() == [2.0, 3.0, 4.0]


def test_a_simulated_run_gives_both_halves_in_the_span_of_the_excitation():
    data1, data2 = halves(excite(FAST, PlantConfig(layer="ideal", seed=3), 3))
    for data in (data1, data2):
        counted = data.counted
        assert 15_000 < counted.sum() < 16_200
        assert 3.0 < data.pressure_kpa[counted].min() < data.pressure_kpa[counted].max() < 112.0
        assert (np.diff(data.time_s) > 0).all()


def test_a_run_without_trajectory_is_refused():
    with pytest.raises(BadFile, match="no trajectory"):
        from_cycles(np.zeros(10, CYCLE), "short")
