"""What calibration makes of readings: right on sensors of any zero and gain within its bounds, and nothing from nonsense."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.deploy import calibration as c
from softloop.devices.config import InclinometerConfig, SensorConfig
from softloop.devices.protocols.quantise import VOLTS_PER_COUNT, counts_to_kpa, deg_to_counts

SENSOR = SensorConfig(zero_v=1.0, full_v=5.0, span_kpa=250.0)
IMU = InclinometerConfig(port="x")


def readings(zero_v, gain, pressure_kpa, count=200):
    """Counts of a sensor whose zero and gain are not the data sheet's."""
    volts = zero_v + gain * pressure_kpa / 250.0 * 4.0
    return [round(volts / VOLTS_PER_COUNT) + i % 3 for i in range(count)]


@given(st.floats(0.65, 1.35), st.floats(0.92, 1.08), st.floats(60, 220))
def test_zero_then_gain_read_a_known_pressure_right(zero_v, gain, known_kpa):
    zero = c.sensor_zero("chamber", SENSOR, c.volts_of(readings(zero_v, gain, 0.0)))
    assert zero.refused == []
    after = SENSOR.model_copy(update={key: value for (_, key), value in zero.keys.items()})
    point = c.sensor_gain("chamber", after, c.volts_of(readings(zero_v, gain, known_kpa)), known_kpa)
    assert point.refused == []
    after = SensorConfig(**(after.model_dump() | {key: value for (_, key), value in point.keys.items()}))
    for pressure_kpa in (0.0, known_kpa, 120.0):
        read = counts_to_kpa(readings(zero_v, gain, pressure_kpa)[1], after.zero_v, after.full_v, after.span_kpa)
        assert read == pytest.approx(pressure_kpa, abs=0.1)


@given(st.lists(st.integers(-32768, 32767), max_size=300), st.floats(-1000, 1000))
def test_whatever_is_read_what_is_written_is_a_sensor(counts, known_kpa):
    volts = c.volts_of(counts)
    for found in (c.sensor_zero("chamber", SENSOR, volts), c.sensor_gain("chamber", SENSOR, volts, known_kpa)):
        assert bool(found.refused) != bool(found.keys)
        if found.keys:
            SensorConfig(**(SENSOR.model_dump() | {key: value for (_, key), value in found.keys.items()}))


@pytest.mark.parametrize(
    ("counts", "said"),
    [
        (readings(1.0, 1.0, 60.0), "reads 60.0 kPa .1.960 V. where 0 should be"),
        ([0] * 200, r"reads -62.5 kPa .0.000 V. where 0 should be"),
        (readings(1.0, 1.0, 0.0, 50), "50 readings are too few"),
        ([3277 + 10 * i for i in range(200)], "moves by 38"),
    ],
)
def test_a_zero_that_is_none_is_refused(counts, said):
    found = c.sensor_zero("chamber", SENSOR, c.volts_of(counts))
    assert found.keys == {}
    assert len(found.refused) == 1
    assert re.search(said, found.refused[0])


def test_a_reading_that_does_not_move_is_said():
    found = c.sensor_zero("chamber", SENSOR, c.volts_of([3277] * 200))
    assert (found.refused, found.lines[0].startswith("warning: chamber: does not move at all")) == ([], True)


@pytest.mark.parametrize(
    ("gain", "known_kpa", "said"), [(1.2, 100.0, "reads 12"), (1.0, 20.0, "tells little"), (1.0, 300.0, "tells little")]
)
def test_a_gain_that_is_none_is_refused(gain, known_kpa, said):
    found = c.sensor_gain("supply", SENSOR, c.volts_of(readings(1.0, gain, known_kpa)), known_kpa)
    assert found.keys == {}
    assert said in found.refused[0]


def angles(angle_deg, count=200):
    return [deg_to_counts(angle_deg) + i % 3 for i in range(count)]


@given(st.sampled_from([1, -1]), st.sampled_from([1, -1]), st.floats(-50, 50), st.floats(-20, 20), st.floats(25, 110))
def test_zero_then_sign_read_a_known_angle_right(mounted, told, at_zero_deg, rest_deg, bent_deg):
    """Mounted either way, whatever the bench file said before."""
    config = IMU.model_copy(update={"direction": told})
    for known, look in ((rest_deg, c.inclinometer_zero), (bent_deg, c.inclinometer_sign)):
        found = look(config, angles(mounted * known + at_zero_deg), known)
        if found.refused:  # the wrong sign until then is an error of twice the rest angle
            assert told != mounted
            assert abs(2 * rest_deg) > c.BEND_ERROR_DEG - 0.1
            return
        config = config.model_copy(update={key: value for (_, key), value in found.keys.items()})
    assert config.direction == mounted
    read = config.direction * (mounted * 60.0 + at_zero_deg) - config.zero_deg
    assert read == pytest.approx(60.0, abs=abs(2 * rest_deg) * (told != mounted) + 0.02)


@pytest.mark.parametrize(
    ("counts", "known", "said"),
    [
        (angles(45.0), 90.0, "reads 45.0 deg at 90 deg, and not with the other sign"),
        (angles(10.0), 10.0, "does not tell the sign"),
        (angles(90.0, 10), 90.0, "too few"),
        ([1000 * (i % 2) for i in range(200)], 90.0, "moves by"),
    ],
)
def test_an_angle_that_cannot_be_is_refused(counts, known, said):
    found = c.inclinometer_sign(IMU, counts, known)
    assert found.keys == {}
    assert said in found.refused[0]


@pytest.mark.parametrize("known", [float("nan"), float("inf"), float("-inf")])
def test_a_known_value_that_is_no_number_gives_nothing(known):
    volts = c.volts_of(readings(1.0, 1.0, 100.0))
    for found in (
        c.sensor_gain("chamber", SENSOR, volts, known),
        c.inclinometer_zero(IMU, angles(45.0), known),
        c.inclinometer_sign(IMU, angles(45.0), known),
    ):
        assert (found.keys, len(found.refused)) == ({}, 1)


def test_what_several_looks_brought_is_one():
    whole = c.joined([c.Found({("a", "b"): 1.0}, ["x"]), c.Found({}, [], ["no"])])
    assert (whole.keys, whole.lines, whole.refused) == ({("a", "b"): 1.0}, ["x"], ["no"])
    assert np.isfinite(list(whole.keys.values())).all()
