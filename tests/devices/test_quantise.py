import struct

import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.devices.protocols import quantise, quantise_kernels
from softloop.devices.protocols.can_frames import DBC_FILE

DBC = cantools.database.load_file(DBC_FILE)
ANY = st.floats(allow_nan=True, allow_infinity=True)
FINITE = st.floats(-1e9, 1e9)
COUNTS = st.integers(-(2**40), 2**40)
SENSOR = st.tuples(st.floats(-9, 4), st.floats(4.5, 10), st.floats(0.5, 5000))


def bits(value):
    """Type and bits, so that -0.0 and 0.0 differ."""
    return struct.pack("<q", value) if isinstance(value, int) else struct.pack("<d", value)


def same(name, *arguments):
    plain = getattr(quantise, name)(*arguments)
    assert bits(plain) == bits(getattr(quantise_kernels, name)(*arguments))
    return plain


def cantools_counts(current_ma):
    data = DBC.encode_message("VALVE_COMMAND", {
        "CRC": 0, "COUNTER": 0, "OUTPUT": 0, "CHARGE_CURRENT": current_ma, "EXHAUST_CURRENT": 0, "SEQ": 0,
    })  # fmt: skip
    return struct.unpack_from("<H", data, 2)[0]


@given(st.floats(0, 655.35))
def test_a_current_becomes_the_counts_that_cantools_writes(current_ma):
    assert same("current_to_counts", current_ma) == cantools_counts(current_ma)


@pytest.mark.parametrize("current_ma", [0.005, 0.015, 0.025, 12.345, 200.005, 219.995, 220.0])
def test_halves_are_rounded_as_cantools_rounds_them(current_ma):
    assert same("current_to_counts", current_ma) == cantools_counts(current_ma)


@given(ANY)
def test_a_current_of_any_kind_stays_in_its_field(current_ma):
    assert 0 <= same("current_to_counts", current_ma) <= 65535


def test_clamped_and_not_a_number():
    assert [quantise.current_to_counts(x) for x in (-1.0, float("nan"), float("inf"), 655.36)] == [0, 0, 65535, 65535]


@given(st.integers(0, 65535))
def test_counts_of_current_go_there_and_back(counts):
    current_ma = same("counts_to_current", counts)
    assert same("current_to_counts", current_ma) == counts
    decoded = DBC.decode_message("VALVE_COMMAND", struct.pack("<HHHH", 0, counts, 0, 0))["CHARGE_CURRENT"]
    assert decoded == current_ma


@given(st.integers(-32768, 32767), SENSOR)
def test_a_pressure_is_cantools_volts_on_the_sensor_line(counts, sensor):
    zero_v, full_v, span_kpa = sensor
    volts = DBC.decode_message("ANALOG_INPUTS", struct.pack("<hhHH", counts, 0, 0, 0))["SUPPLY"]
    assert same("counts_to_kpa", counts, *sensor) == (volts - zero_v) / (full_v - zero_v) * span_kpa


@given(st.integers(-32768, 32767), SENSOR)
def test_pressure_counts_go_there_and_back(counts, sensor):
    assert same("kpa_to_counts", same("counts_to_kpa", counts, *sensor), *sensor) == counts


@given(ANY, SENSOR)
def test_a_pressure_of_any_kind_stays_in_its_field(pressure_kpa, sensor):
    assert -32768 <= same("kpa_to_counts", pressure_kpa, *sensor) <= 32767


@given(st.integers(-32768, 32767))
def test_angle_and_rate_counts_go_there_and_back(counts):
    assert same("deg_to_counts", same("counts_to_deg", counts)) == counts
    assert same("value_to_int16", same("counts_to_deg_s", counts), 2000.0) == counts


@given(FINITE)
def test_an_angle_wraps_into_int16(angle_deg):
    counts = same("deg_to_counts", angle_deg)
    assert -32768 <= counts <= 32767
    turns = (quantise.counts_to_deg(counts) - angle_deg) / 360.0
    assert abs(turns - round(turns)) * 360.0 <= 0.5 * 180 / 32768 + 1e-6


@given(ANY, st.sampled_from([2000.0, 180.0, 16.0]))
def test_a_value_saturates_in_int16(value, full_scale):
    counts = same("value_to_int16", value, full_scale)
    assert -32768 <= counts <= 32767
    if abs(value) < full_scale * 0.9999:
        assert abs(counts - value / full_scale * 32768) <= 0.5


@given(COUNTS)
def test_unwrapped_angles_of_any_size_are_exact_multiples(counts):
    assert same("counts_to_deg", counts) == counts * 180 / 32768
