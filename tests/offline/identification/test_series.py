import numpy as np
import pytest

from softloop.controller.records import CYCLE
from softloop.offline.identification.experiments import FAST, excite, halves
from softloop.offline.identification.series import Series, from_cycles, nrmse_fit
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
