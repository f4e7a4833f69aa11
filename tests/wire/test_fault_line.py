"""What injections do to what passes: each kind, and that chance is named by the seed."""

from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from softloop.wire.can_frame import MAX_DLC
from softloop.wire.fault_config import (
    CAN_TARGETS,
    SENSOR_TARGETS,
    SIZES_MOST,
    ZENOH_BITS,
    ZENOH_TARGETS,
    FaultsConfig,
    InjectionConfig,
)
from softloop.wire.fault_line import Line, Strike, flip_bits
from softloop.wire.messages import message

S = 1_000_000_000
MS = 1_000_000


def strike(kind, target="analog", at_s=1.0, duration_s=1.0, armed_ns=0, said=None, seed=1, **more):
    config = InjectionConfig(kind=kind, target=target, at_s=at_s, duration_s=duration_s, **more)
    return Strike(config, Random(seed), lambda: armed_ns, lambda *word: None if said is None else said.append(word))


def passed(*strikes, things=400, alter=lambda thing, _: -thing):
    """(time in ms, thing) of all that comes out of a line into which thing n is put at 5 n ms."""
    line, out = Line(list(strikes), alter), []
    for n in range(1, things + 100):
        now_ns = 5 * n * MS
        if n < things:
            line.put(n, now_ns)
        out += [(5 * n, thing) for thing in line.take_all(now_ns)]
    return out


def during(out):
    """What came from the second second."""
    return [(at, thing) for at, thing in out if 200 <= abs(thing) < 400]


def test_without_injections_all_comes_at_once_and_in_order():
    assert passed() == [(5 * n, n) for n in range(1, 400)]


def test_it_acts_from_its_begin_to_before_its_end_and_says_so():
    said = []
    out = passed(strike("can_drop", duration_s=0.5, said=said))
    assert [thing for _, thing in out] == [*range(1, 200), *range(300, 400)]
    assert said == [(1, S), (0, round(1.5 * S))]


def test_times_count_from_arming_and_nothing_happens_before():
    assert len(passed(strike("can_drop", armed_ns=None))) == 399
    assert [thing for _, thing in passed(strike("can_drop", armed_ns=round(0.5 * S)))][-1] == 299


def test_delay_is_kept_and_order_too():
    out = during(passed(strike("can_delay", size=12.0)))
    assert [thing for _, thing in out] == list(range(200, 400))
    assert {at - 5 * thing for at, thing in out} == {15}  # noticed at the next 5 ms


def test_duplicate_comes_twice():
    out = during(passed(strike("can_duplicate")))
    assert [thing for _, thing in out] == [n for n in range(200, 400) for _ in range(2)]


def test_reorder_swaps_neighbours_and_loses_nothing():
    things = [thing for _, thing in during(passed(strike("can_reorder")))]
    assert things[:6] == [201, 200, 203, 202, 205, 204]
    assert sorted(things) == list(range(200, 400))


def test_what_is_altered_is_altered_while_it_lasts_alone():
    assert [thing for _, thing in passed(strike("can_corrupt", duration_s=0.5))] == [
        *range(1, 200), *range(-200, -300, -1), *range(300, 400),
    ]  # fmt: skip


def test_chance_follows_its_probability_and_its_seed():
    first, again, other = (passed(strike("can_drop", probability=0.3, seed=seed)) for seed in (1, 1, 2))
    assert first == again != other
    assert 0.2 < 1 - len(during(first)) / 200 < 0.4


def test_several_act_together():
    out = during(passed(strike("can_duplicate"), strike("can_delay", size=5.0)))
    assert [thing for _, thing in out] == [n for n in range(200, 400) for _ in range(2)]
    assert {at - 5 * thing for at, thing in out} == {5}


@given(st.binary(min_size=1, max_size=40), st.integers(0, 9))
def test_flipped_bits_are_as_many_as_asked_or_fewer_and_stay_within(data, bits):
    spoiled = flip_bits(data, strike("can_corrupt", size=float(bits)), first=len(data) // 2)
    changed = sum((a ^ b).bit_count() for a, b in zip(data, spoiled, strict=True))
    assert changed <= max(1, bits)
    assert changed % 2 == max(1, bits) % 2  # a bit may be hit twice
    assert spoiled[: len(data) // 2] == data[: len(data) // 2]
    assert len(spoiled) == len(data)


def test_no_byte_no_bit():
    assert flip_bits(b"", strike("can_corrupt")) == b""


@pytest.mark.parametrize("injection", [
    {"kind": "can_drop", "target": "inclinometer"}, {"kind": "serial_drop", "target": "driver"}, {"kind": "can_delay"},
    {"kind": "can_delay", "target": "driver"}, {"kind": "can_drop", "target": "driver", "size": 1.0},
    {"kind": "sensor_noise", "target": "angle", "size": -1.0}, {"kind": "can_bus_off", "target": "command"},
    {"kind": "process_kill", "target": "plants"}, {"kind": "process_kill", "target": "plant", "probability": 0.5},
    {"kind": "can_drop", "target": "driver", "duration_s": 0.0}, {"kind": "can_drop", "target": "driver", "probability": 0.0},
    {"kind": "clock_step"}, {"kind": "can_drop", "target": "driver", "sise": 1.0},
])  # fmt: skip
def test_an_injection_that_makes_no_sense_is_refused(injection):
    with pytest.raises(ValidationError):
        InjectionConfig.model_validate({"at_s": 1.0, **injection})


@pytest.mark.parametrize(("kind", "target", "most"), [
    ("can_corrupt", "analog", 8 * MAX_DLC), ("can_corrupt", "command", 8 * MAX_DLC), ("serial_corrupt", "inclinometer", 8),
    ("zenoh_corrupt", "pressure", 8 * message("PressureSample").cdr_size),
    ("zenoh_corrupt", "command", 8 * message("ValveCommand").cdr_size),
    ("can_delay", "analog", 60_000), ("serial_delay", "inclinometer", 60_000), ("zenoh_delay", "valves", 60_000),
    ("clock_step", "controller", 3_600_000), ("clock_step", "controller", -3_600_000),
    ("sensor_bias", "chamber_pressure", 1000), ("sensor_bias", "angle", -360), ("sensor_noise", "rate", 1000),
])  # fmt: skip
def test_a_size_beyond_which_nothing_more_goes_wrong_is_a_typo(kind, target, most):
    injection = {"kind": kind, "target": target, "at_s": 1.0}
    assert InjectionConfig.model_validate({**injection, "size": most}).size == most
    for beyond in (most + (1 if most > 0 else -1), 1e18 if most > 0 else -1e18):
        with pytest.raises(ValidationError, match=rf"size of '{kind}' must be at most {abs(most)} \(.*\), got "):
            InjectionConfig.model_validate({**injection, "size": beyond})


@pytest.mark.parametrize("kind", ["can_corrupt", "serial_corrupt", "zenoh_corrupt"])
def test_half_a_bit_cannot_be_flipped(kind):
    target = {"can_corrupt": "driver", "serial_corrupt": "inclinometer", "zenoh_corrupt": "command"}[kind]
    assert InjectionConfig(kind=kind, target=target, at_s=0.0, size=3.0).size == 3.0
    with pytest.raises(ValidationError, match=f"size of '{kind}' must be a whole number of bits, got 2.5"):
        InjectionConfig(kind=kind, target=target, at_s=0.0, size=2.5)


def test_every_channel_and_sensor_has_its_largest_size():
    assert set(ZENOH_TARGETS) == set(ZENOH_BITS)
    assert set(SENSOR_TARGETS) < set(SIZES_MOST)


def test_each_process_is_given_its_own_with_their_places():
    given_all = [{"kind": "can_drop", "target": t, "at_s": 0.0} for t in CAN_TARGETS]
    config = FaultsConfig.model_validate({"injections": given_all})
    assert [place for place, _ in config.of_process("valves")] == [1, 2]
    assert [place for place, _ in config.of_process("pressures")] == [0]
    assert config.of_process("controller") == []
