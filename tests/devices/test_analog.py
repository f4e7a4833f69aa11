"""Counting and judging the analogue module's frames: as it is and compiled, to the bit."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.devices.protocols.analog import (
    ANALOG_CONFIG,
    ANALOG_STATE,
    NOTHING,
    SAMPLE,
    AnalogConfig,
    AnalogState,
    analog_step,
)
from softloop.devices.protocols.analog_kernels import analog_step as compiled_step

CONFIG = AnalogConfig(270_000, -5.0, 255.0, -5.0, 255.0)
FRAME = st.tuples(
    st.integers(0, 255), st.floats(-400, 400), st.floats(-400, 400), st.integers(0, 2**40), st.integers(0, 2**40)
)  # fmt: skip


def records():
    config, state = np.zeros(1, ANALOG_CONFIG)[0], np.zeros(1, ANALOG_STATE)[0]
    for name in ANALOG_CONFIG.names:
        config[name] = getattr(CONFIG, name)
    state.counter = -1
    return config, state


@given(st.lists(FRAME, min_size=1, max_size=30))
def test_compiled_and_plain_agree(frames):
    plain, (config, state) = AnalogState(), records()
    for frame in frames:
        assert analog_step(CONFIG, plain, *frame) == compiled_step(config, state, *frame)
        assert {n: int(state[n]) for n in ANALOG_STATE.names} == vars(plain)


def test_a_repeated_frame_is_nothing_and_lost_ones_are_counted_over_the_wrap():
    state = AnalogState()
    assert [analog_step(CONFIG, state, c, 0.0, 0.0, 0, 0) for c in (254, 254, 1)] == [SAMPLE, NOTHING, SAMPLE]
    assert (state.seq, state.missed) == (2, 2)


@pytest.mark.parametrize(("stamp", "received", "expected"), [(1_000_000, 1_270_000, 1_000_000), (900_000, 1_400_000, 900_000)])
def test_the_stamp_is_the_frames_own_or_its_time_on_the_wire_ago(stamp, received, expected):
    state = AnalogState()
    analog_step(CONFIG, state, 0, 0.0, 0.0, stamp, received)
    assert state.stamp_ns == expected


def test_a_reading_outside_its_span_is_out_of_range():
    state = AnalogState()
    for counter, (supply, chamber, fits) in enumerate([(200.0, 60.0, 1), (256.0, 60.0, 0), (200.0, -5.1, 0), (np.nan, 60.0, 0)]):
        analog_step(CONFIG, state, counter, supply, chamber, 0, 0)
        assert state.in_range == fits
