"""Pressure tracking: against the desired pressure of the sample's own time, from the first sample on the trajectory."""

import numpy as np
import pytest

from softloop.controller.config import ControllerConfig
from softloop.controller.records import CYCLE, PHASE_APPROACH, PHASE_TRACK
from softloop.offline.closed_loop import Run, simulate_run
from softloop.offline.excitation import run_tracking
from softloop.offline.excitation_figure import figure_2ab
from softloop.offline.loop_records import TRUTH
from softloop.plant.config import PlantConfig
from softloop.wire.errors import BadFile

DELAY_MS, AGE_NS, TICK_NS = 3.0, 4_000_000, 5_000_000


def ramp_run(error_kpa=0.0, rate_kpa_s=100.0):
    """A desired pressure that rises evenly, followed but for `error_kpa`; the approach before it is far off."""
    cycles, truths = np.zeros(400, CYCLE), np.zeros(400, TRUTH)
    stamps = 10**9 + np.arange(400) * TICK_NS
    cycles["stamp_ns"], truths["stamp_ns"] = stamps, stamps
    cycles["phase"] = np.where(np.arange(400) < 100, PHASE_APPROACH, PHASE_TRACK)
    cycles["desired_pressure_kpa"] = rate_kpa_s * (1e-9 * stamps + 1e-3 * DELAY_MS)
    cycles["pressure_stamp_ns"] = stamps - AGE_NS
    cycles["chamber_pressure_kpa"] = rate_kpa_s * 1e-9 * (stamps - AGE_NS) + error_kpa
    cycles["chamber_pressure_kpa"][:100] += 50.0
    truths["chamber_pressure_kpa"] = rate_kpa_s * 1e-9 * stamps - 1.5
    return Run(cycles, truths)


def test_age_and_delay_are_no_tracking_error():
    found = run_tracking(ramp_run(), DELAY_MS)
    assert found.max_kpa == pytest.approx(0.0, abs=1e-9)
    assert found.truth_max_kpa == pytest.approx(1.5)


@pytest.mark.parametrize(("error", "kept"), [(1.9, True), (-2.1, False)])
def test_the_bar_is_two_kpa_either_way(error, kept):
    found = run_tracking(ramp_run(error), DELAY_MS)
    assert found.max_kpa == pytest.approx(abs(error))
    assert found.rms_kpa == pytest.approx(abs(error))
    assert found.kept == kept


def test_a_run_that_tracked_no_pressure_is_refused():
    run = ramp_run()
    run.cycles["phase"] = PHASE_APPROACH
    with pytest.raises(BadFile, match="no pressure was tracked"):
        run_tracking(run, DELAY_MS)


def test_the_picture_has_a_pair_of_panels_for_each_run():
    figure = figure_2ab({"a": run_tracking(ramp_run(), DELAY_MS), "b": run_tracking(ramp_run(1.0), DELAY_MS)})
    assert len(figure.axes) == 4
    assert "1.00 kPa" in figure.axes[2].get_title(loc="left")


@pytest.mark.parametrize("law", ["pressure", "pressure_eso"])
def test_both_laws_follow_the_multi_sine_of_an_ideal_rig(law):
    controller = ControllerConfig(law=law, trajectory="excitation_05hz")
    found = run_tracking(simulate_run(controller, PlantConfig(layer="ideal")), controller.actuation_delay_ms)
    assert found.max_kpa < 5.0
    assert found.time_s[-1] > 159.0
