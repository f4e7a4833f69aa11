"""The simulated plant that follows a rig, on what a whole rig in this process left."""

import random
from math import isnan, nan, pi, sin

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from softloop.controller.config import ControllerConfig
from softloop.offline.closed_loop import RigTables, simulate_trace
from softloop.plant.config import PlantConfig
from softloop.plant.shadow import PERIOD_NS, Shadow
from softloop.plant.shadow_config import ShadowConfig, ShadowProcess
from softloop.wire.messages import constant, message
from softloop.wire.schedule import make_schedule

KINDS = {"valves": "ValveStatus", "pressure": "PressureSample", "inclination": "InclinationSample"}
MS = 1_000_000


def shadow(**keys):
    return Shadow(ShadowProcess(ShadowConfig(**keys), 500_000))


@pytest.fixture(scope="module")
def heard():
    """(channel, message) of a rig of seed 1 that follows T2 for 8 s, in the order of their stamps."""
    controller = ControllerConfig(trajectory="t2", approach_s=1.0)
    trace = simulate_trace(RigTables(controller, PlantConfig(seed=1)), make_schedule(0.5, 8.0, 0.5))
    records = {"valves": trace.statuses, "pressure": trace.pressures, "inclination": trace.inclinations}
    found = [(name, message(KINDS[name]).Tuple(*one.tolist())) for name, all_of in records.items() for one in all_of]
    return sorted(found, key=lambda item: item[1].stamp_ns)


def followed(heard, one, *, to_ns=None):
    for name, sample in heard:
        one.put(name, sample)
    return one.advance_to(to_ns or heard[-1][1].stamp_ns)


def rms(said, field):
    return float(np.sqrt(np.nanmean([getattr(one, field) ** 2 for one in said])))


def test_a_twin_of_the_rig_is_as_far_from_it_as_its_noise(heard):
    said = followed(heard, shadow(seed=1))
    assert len(said) > 150
    assert rms(said, "angle_residual_deg") < 0.08  # noise 0.05 deg, steps of 0.0055 deg
    assert rms(said, "chamber_residual_kpa") < 0.16  # noise 0.1 kPa, steps of 0.12 kPa
    assert rms(said, "supply_residual_kpa") < 0.16
    assert rms(said, "rate_residual_deg_s") < 0.3
    assert said[-1].left_out == 0


def test_another_specimen_is_clearly_farther(heard):
    said, twin = followed(heard, shadow(seed=2)), followed(heard, shadow(seed=1))
    for field, times in (("angle_residual_deg", 20), ("chamber_residual_kpa", 5), ("rate_residual_deg_s", 5)):
        assert rms(said, field) > times * rms(twin, field), field


def test_without_correction_another_specimen_drifts_and_with_it_not(heard):
    free, held = followed(heard, shadow(seed=2, correction_s=0.0)), followed(heard, shadow(seed=2))
    assert rms(free, "chamber_residual_kpa") > 5 * rms(held, "chamber_residual_kpa")
    assert {one.correction_kpa_s for one in free} == {0.0}
    limited = followed(heard, shadow(seed=2, correction_max_kpa_s=3.0))
    assert max(abs(one.correction_kpa_s) for one in limited) == 3.0


def test_measured_currents_drive_it_too(heard):
    assert rms(followed(heard, shadow(currents="measured")), "chamber_residual_kpa") < 2.0


def test_while_the_driver_vents_by_itself_its_measured_currents_count():
    status = message("ValveStatus").make(
        stamp_ns=50,
        driver_stamp_ns=7,
        charge_current_ma=1.0,
        charge_coil_ma=2.0,
        driver=constant("ValveStatus", "DRIVER_WATCHDOG"),
    )
    assert shadow().currents_of(status) == (7, (2.0, 0.0))
    sent_ns, sent = shadow().currents_of(status._replace(driver=constant("ValveStatus", "DRIVER_OK")))
    assert sent_ns > 50
    assert sent == (1.0, 0.0)


@pytest.mark.parametrize(("seed", "span"), [(1, 1), (2, 7), (3, 40)])
def test_the_order_in_which_messages_come_changes_nothing(heard, seed, span):
    """As long as they come within what it stays behind the clock, in however many turns they are taken."""
    some = heard[:900]
    last_ns = some[-1][1].stamp_ns
    expected = followed(some, shadow(seed=2), to_ns=last_ns)
    one, said, chance = shadow(seed=2), [], random.Random(seed)
    late = sorted(some, key=lambda item: item[1].stamp_ns + chance.randrange(span * MS))
    for name, sample in late:
        one.put(name, sample)
        said += one.advance_to(sample.stamp_ns - span * MS)
    assert [tuple(map(str, a)) for a in said + one.advance_to(last_ns)] == [tuple(map(str, a)) for a in expected]


@given(st.lists(st.sampled_from([nan, float("inf"), -1e300, 1e300, -5.0, 0.0, 300.0]), min_size=6, max_size=6), st.integers(0, 3))
@settings(max_examples=30, deadline=None, phases=[Phase.generate])
def test_any_value_leaves_it_running(heard, values, driver):
    """What is no number is left out; what is out of range is held to what a rig can be."""
    one = shadow()
    said = followed(heard[:60], one)
    stamp_ns = heard[60][1].stamp_ns
    status = {"charge_current_ma": values[0], "exhaust_current_ma": values[1], "driver": driver, "stamp_ns": stamp_ns}
    one.put("valves", message("ValveStatus").make(driver_stamp_ns=stamp_ns, **status))
    made = message("PressureSample").make
    one.put("pressure", made(stamp_ns=stamp_ns, chamber_pressure_kpa=values[2], supply_pressure_kpa=values[3]))
    one.put("inclination", message("InclinationSample").make(stamp_ns=stamp_ns, angle_deg=values[4], rate_deg_s=values[5]))
    said = one.advance_to(stamp_ns + 200 * MS)
    assert len(said) >= 3
    assert np.isfinite(said[-1].angle_deg)
    assert 0.0 <= said[-1].chamber_pressure_kpa + 5.0 < 300.0


def test_a_sample_that_came_too_late_is_counted_and_a_silent_sensor_has_no_residual(heard):
    one = shadow()
    followed(heard[:900], one)
    at_ns = heard[899][1].stamp_ns
    one.put("pressure", message("PressureSample").make(stamp_ns=at_ns - 50 * MS))
    last = one.advance_to(at_ns + 2_000 * MS)[-1]
    assert last.left_out == 1
    assert isnan(last.angle_residual_deg)
    assert isnan(last.angle_rms_deg)
    assert last.stamp_ns % PERIOD_NS == 0


def test_begun_amid_a_run_it_takes_the_state_that_is_measured(heard):
    amid = [item for item in heard if item[1].stamp_ns > heard[-1][1].stamp_ns - 5_000 * MS]
    said = followed(amid, shadow(seed=1))
    assert abs(said[0].angle_residual_deg) < 3.0
    assert said[0].since_ns >= amid[0][1].stamp_ns
    assert rms(said[-20:], "angle_residual_deg") < 5.0  # its memory and its play are not known


def test_nothing_is_said_before_every_channel_was_heard():
    one = shadow()
    wave = [(k, 60.0 + 10.0 * sin(2 * pi * k / 200)) for k in range(200)]
    for k, angle in random.Random(1).sample(wave, len(wave)):
        one.put("inclination", message("InclinationSample").make(stamp_ns=k * 5 * MS, angle_deg=angle))
    assert one.advance_to(2_000 * MS) == []
