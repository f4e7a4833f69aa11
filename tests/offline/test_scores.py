from math import inf

import numpy as np
import pytest

from softloop.controller.records import CYCLE, PHASE_APPROACH, PHASE_TRACK
from softloop.offline.closed_loop import Run
from softloop.offline.loop_records import TRUTH
from softloop.offline.scores import RECOVERED_DEG, Scores, recovery_s, run_scores
from softloop.wire.schedule import PERIOD_NS, START_NS

APPROACH = 100  # ticks before the trajectory


def a_run(error_deg, *, rate_deg_s=1.0, mode=1, **result):
    """A run whose true angle differs from its reference by `error_deg` on the trajectory, and by 50 degrees before it."""
    n = APPROACH + len(error_deg)
    cycles, truths = np.zeros(n, CYCLE), np.zeros(n, TRUTH)
    cycles["stamp_ns"] = truths["stamp_ns"] = START_NS + PERIOD_NS * np.arange(n)
    cycles["phase"][:APPROACH], cycles["phase"][APPROACH:] = PHASE_APPROACH, PHASE_TRACK
    cycles["reference_deg"] = 60.0
    cycles["reference_rate_deg_s"][APPROACH:] = rate_deg_s
    cycles["mode"][APPROACH:] = mode
    truths["angle_deg"] = 110.0
    truths["angle_deg"][APPROACH:] = 60.0 + np.asarray(error_deg)
    return Run(cycles, truths, **result)


def track_ns(seconds):
    """Rig clock of a time on the trajectory."""
    return START_NS + APPROACH * PERIOD_NS + round(seconds * 1e9)


def test_errors_count_from_the_first_sample_of_the_trajectory_and_not_before():
    error = np.zeros(1000)
    error[0], error[700] = -3.0, 2.0
    scores = run_scores(a_run(error))
    assert scores.max_error_deg == pytest.approx(3.0)
    assert scores.rms_error_deg == pytest.approx(np.sqrt(13.0 / 1000))
    assert scores.steady_error_deg is None  # the reference never stands
    assert (scores.peak_deg, scores.recovery_s) == (None, None)


def test_the_steady_error_is_of_the_last_two_seconds_of_every_dwell():
    rate = np.zeros(2000)
    rate[800:1000] = 5.0  # dwells of 4 s and 5 s
    error = np.zeros(2000)
    error[799 - 401], error[900], error[1999 - 401] = 9.0, 9.0, 9.0  # just before the last 2 s, and on the move
    error[799 - 400], error[1999] = -0.5, 0.7
    assert run_scores(a_run(error, rate_deg_s=rate)).steady_error_deg == pytest.approx(0.7)
    error[1999] = 0.0
    assert run_scores(a_run(error, rate_deg_s=rate)).steady_error_deg == pytest.approx(0.5)


def test_switches_are_counted_per_second_of_trajectory():
    mode = np.repeat([1, 3, 2, 3], 250)
    assert run_scores(a_run(np.zeros(1000), mode=mode)).switches_per_s == pytest.approx(3 / (999 * 0.005))


@pytest.mark.parametrize("result", [{"fault": "inputs too old"}, {"completed": False}])
def test_a_run_that_was_lost_scores_infinite_however_small_its_errors_were(result):
    assert run_scores(a_run(np.zeros(1000), **result)) == Scores(inf, inf, inf, inf)
    with_loads = run_scores(a_run(np.zeros(1000), **result), [track_ns(1.0)])
    assert (with_loads.peak_deg, with_loads.recovery_s) == (inf, inf)


def test_a_run_without_trajectory_and_one_that_is_no_number_are_lost():
    assert run_scores(a_run([])).max_error_deg == inf
    error = np.zeros(1000)
    error[500] = np.nan
    assert run_scores(a_run(error)).max_error_deg == inf


def test_peak_and_recovery_are_of_the_worse_of_coming_and_leaving():
    error = np.zeros(2000)
    error[100:150] = 8.0  # before the load came
    error[400:520] = 1.0  # it comes at 2 s
    error[1200:1500] = 0.9  # and leaves at 6 s
    error[1700] = 3.0  # more than 2 s after it left
    scores = run_scores(a_run(error), [track_ns(2.0), track_ns(6.0)])
    assert scores.max_error_deg == pytest.approx(8.0)
    assert scores.peak_deg == pytest.approx(1.0)
    assert scores.recovery_s == pytest.approx(1.5)


def test_loads_that_come_off_the_trajectory_give_no_scores_of_their_own():
    scores = run_scores(a_run(np.zeros(1000)), [START_NS, track_ns(100.0)])
    assert (scores.peak_deg, scores.recovery_s) == (None, None)


def test_recovery_needs_the_error_to_stay_small():
    time_s = 0.005 * np.arange(1000)
    size = np.zeros(1000)
    assert recovery_s(time_s, size) == 0.0
    size[10:200] = RECOVERED_DEG  # not under it
    assert recovery_s(time_s, size) == pytest.approx(1.0)
    size[220] = 1.0  # 0.1 s of calm are not enough
    assert recovery_s(time_s, size) == pytest.approx(221 * 0.005)
    size[230::30] = 1.0
    assert recovery_s(time_s, size) == inf
