"""The WT931's bytes, and samples from a line that loses some of them."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from softloop.devices.protocols import wt931, wt931_kernels
from softloop.devices.protocols.quantise import deg_to_counts, value_to_int16
from softloop.devices.protocols.wire_time import serial_ns

PERIOD_NS = 5_000_000
BAUD = 115_200
BURST_NS = serial_ns(wt931.SAMPLE_BYTES, BAUD)
INT16 = st.integers(-32768, 32767)
WORDS = st.tuples(INT16, INT16, INT16, INT16)
KINDS = st.sampled_from(sorted(wt931.TYPES))
PACKETS = st.lists(st.tuples(KINDS, WORDS), max_size=20)


def bounds():
    return wt931.sampler_config(200, 1000.0, 1.0, 20_000.0, 20.0)


def chunks_of(data, sizes):
    at = 0
    while at < len(data):
        size = sizes[at % len(sizes)]
        yield data[at : at + size]
        at += size


def test_the_documented_example_packet():
    sent = wt931.encode_packet(wt931.ANGLE, (8192, -1820, 32749, 0x2711))
    assert sent.hex() == "55530020e4f8ed7f112748"


@given(PACKETS, st.lists(st.integers(1, 30), min_size=1, max_size=5))
def test_packets_come_back_however_the_stream_is_cut(packets, sizes):
    stream = b"".join(wt931.encode_packet(*p) for p in packets)
    parser = wt931.Parser()
    found = [p for chunk in chunks_of(stream, sizes) for p in parser.feed(chunk)]
    assert [(p.kind, p.words) for p in found] == packets
    assert [p.end for p in found] == [11 * (i + 1) for i in range(len(packets))]
    assert (parser.taken, parser.accepted, parser.skipped) == (len(stream), len(packets), 0)


@given(st.binary(max_size=300), st.lists(st.integers(1, 30), min_size=1, max_size=5))
def test_any_bytes_are_survived_and_accounted_for_however_they_are_cut(data, sizes):
    whole, cut = wt931.Parser(), wt931.Parser()
    expected = whole.feed(data)
    assert [p for chunk in chunks_of(data, sizes) for p in cut.feed(chunk)] == expected
    assert vars(whole) == vars(cut)
    cut.forget()
    assert cut.taken == len(data) == 11 * cut.accepted + cut.skipped


@given(WORDS, WORDS, st.integers(0, 10))
def test_a_lost_byte_costs_at_most_its_own_packet(first, second, lost):
    """Unless what is left of it looks like a head, or the next head like its sum: that is left to `Sampler`."""
    one, two = wt931.encode_packet(wt931.GYRO, first), wt931.encode_packet(wt931.ANGLE, second)
    rest = one[:lost] + one[lost + 1 :]
    assume(wt931.HEAD not in rest[1:] and sum(rest) & 0xFF != wt931.HEAD)
    found = wt931.Parser().feed(rest + two)
    assert (wt931.ANGLE, second) in [(p.kind, p.words) for p in found]


def test_resynchronising_goes_on_one_byte_later():
    good = wt931.encode_packet(wt931.ANGLE, (1, 2, 3, 4))
    parser = wt931.Parser()
    assert [p.words for p in parser.feed(b"\x55\x53" + good)] == [(1, 2, 3, 4)]  # a false head two bytes before the true one
    assert (parser.bad_sum, parser.skipped) == (1, 2)


def test_types_that_are_not_enabled_are_counted_and_left_out():
    parser = wt931.Parser(frozenset((wt931.ANGLE,)))
    stream = wt931.encode_packet(wt931.GYRO, (0, 0, 0, 0)) + wt931.encode_packet(wt931.ANGLE, (9, 0, 0, 0))
    assert [p.words[0] for p in parser.feed(stream)] == [9]
    assert parser.unknown_type == 1


def test_documented_commands():
    assert wt931.encode_unlock().hex() == "ffaa6988b5"
    assert wt931.encode_command(wt931.RSW, wt931.RSW_GYRO_ANGLE).hex() == "ffaa020c00"
    assert wt931.encode_command(wt931.READ, wt931.BANDWIDTH).hex() == "ffaa271f00"
    assert wt931.settings(200, 256) == {wt931.RSW: 12, wt931.RRATE: 0x0B, wt931.BANDWIDTH: 0, wt931.AXIS6: 1}


@given(
    st.lists(st.tuples(st.integers(0, 0x69), st.integers(0, 0xFFFF)), max_size=10),
    st.lists(st.integers(1, 9), min_size=1, max_size=4),
)
def test_commands_come_back_however_the_stream_is_cut(commands, sizes):
    parser = wt931.CommandParser()
    stream = b"\x00" + b"".join(wt931.encode_command(*c) for c in commands)
    assert [c for chunk in chunks_of(stream, sizes) for c in parser.feed(chunk)] == commands


@given(st.binary(max_size=60), st.lists(st.integers(1, 9), min_size=1, max_size=4))
def test_the_command_parser_survives_any_bytes(data, sizes):
    whole, cut = wt931.CommandParser(), wt931.CommandParser()
    assert [c for chunk in chunks_of(data, sizes) for c in cut.feed(chunk)] == whole.feed(data)


# --- sample_step ------------------------------------------------------------------------------------------------------------

STEP = st.tuples(st.integers(0, 1), INT16, INT16, st.sampled_from([7, 8]), st.integers(0, 20_000_000))
NEAR = st.tuples(st.just(1), st.integers(-50, 50), st.integers(-300, 300), st.just(7), st.just(PERIOD_NS))


@given(st.lists(STEP | NEAR, max_size=60))
def test_compiled_and_plain_do_the_same(steps):
    config, state = bounds(), wt931.SamplerState()
    config_record, state_record = wt931.as_record(config, wt931.SAMPLER_CONFIG), wt931.as_record(state, wt931.SAMPLER_STATE)
    now_ns = 0
    for has_gyro, gyro, angle, version, dt_ns in steps:
        now_ns += dt_ns
        given_ = (has_gyro, gyro, angle, version, now_ns)
        plain = wt931.sample_step(config, state, *given_)
        assert plain == wt931_kernels.sample_step(config_record, state_record, *given_)
        assert wt931.as_record(state, wt931.SAMPLER_STATE).tobytes() == state_record.tobytes()


@given(st.lists(STEP, max_size=40))
def test_whatever_came_before_the_third_good_packet_is_a_sample_and_true(junk):
    config, state = bounds(), wt931.SamplerState()
    now_ns = 0
    for has_gyro, gyro, angle, version, dt_ns in junk:
        now_ns += dt_ns
        wt931.sample_step(config, state, has_gyro, gyro, angle, version, now_ns)
    for k in range(5):
        now_ns += PERIOD_NS
        angle = 1000 + 100 * k
        kind = wt931.sample_step(config, state, 1, 300, angle, 7, now_ns)
        if k >= wt931.CONFIRMATIONS - 1:
            assert kind == wt931.SAMPLE
            assert state.rate == 300
            assert (state.turned - angle) % 65536 == 0


def started(angle=0):
    config, state = bounds(), wt931.SamplerState()
    for k in range(3):
        kind = wt931.sample_step(config, state, 1, 0, angle, 7, (k + 1) * PERIOD_NS)
    assert kind == wt931.SAMPLE
    return config, state, 4 * PERIOD_NS


@pytest.mark.parametrize("angle", [3000, -3000, 20000])
def test_a_jump_is_not_believed_once(angle):
    config, state, now_ns = started()
    assert wt931.sample_step(config, state, 1, 0, angle, 7, now_ns) == wt931.NOTHING
    assert state.rejected == 2 + 2 + 1  # gyro and angle before they were confirmed, and the jump
    assert wt931.sample_step(config, state, 1, 0, 10, 7, now_ns + PERIOD_NS) == wt931.SAMPLE
    assert state.turned == 10


def test_another_version_word_is_not_believed():
    config, state, now_ns = started()
    assert wt931.sample_step(config, state, 1, 0, 0, 8, now_ns) == wt931.NOTHING


def test_an_impossible_rate_leaves_the_angle_and_the_last_rate():
    config, state, now_ns = started()
    assert wt931.sample_step(config, state, 1, 20_000, 50, 7, now_ns) == wt931.SAMPLE_WITHOUT_RATE
    assert (state.turned, state.rate) == (50, 0)


def test_a_missing_gyro_packet_leaves_the_last_rate():
    config, state, now_ns = started()
    assert wt931.sample_step(config, state, 0, 12345, 50, 7, now_ns) == wt931.SAMPLE_WITHOUT_RATE
    assert (state.turned, state.rate) == (50, 0)


@given(st.floats(-900.0, 900.0))
def test_angles_go_on_past_180_degrees(rate_deg_s):
    config, state, now_ns = started()
    for k in range(1, 500):
        angle_deg = rate_deg_s * k * 0.005
        assert wt931.sample_step(config, state, 0, 0, deg_to_counts(angle_deg), 7, now_ns + k * PERIOD_NS)
    assert abs(state.turned * 180 / 32768 - angle_deg) <= 180 / 32768


# --- bytes to samples ---------------------------------------------------------------------------------------------------------


def truth(k):
    """Counts of rate and angle of sample `k`: a sine of 110 deg that crosses 180 deg."""
    phase, omega = k * PERIOD_NS * 1e-9 * 6.1, 6.1
    angle_deg, rate_deg_s = 110 + 110 * math.sin(phase), 110 * omega * math.cos(phase)
    return value_to_int16(rate_deg_s, 2000.0), round(angle_deg / 180 * 32768)


def burst(k):
    rate, turned = truth(k)
    angle = deg_to_counts(turned * 180 / 32768)
    return wt931.encode_packet(wt931.GYRO, (rate, 3, -2, 2500)) + wt931.encode_packet(wt931.ANGLE, (angle, 40, 50, 0x2711))


def arrival(k):
    return k * PERIOD_NS + BURST_NS


def replay(count, loss, seed):
    """Samples from `count` bursts of which each byte is lost with probability `loss`, as (burst, sample)."""
    rng = np.random.default_rng(seed)
    kept = rng.random((count, wt931.SAMPLE_BYTES)) >= loss
    sampler = wt931.Sampler(bounds(), BAUD)
    found = []
    for k in range(count):
        data = burst(k)
        if not kept[k].all():
            data = bytes(b for b, keep in zip(data, kept[k], strict=True) if keep)
        found += [(k, sample) for sample in sampler.feed(data, arrival(k))]
    return found, sampler


def is_true(k, sample):
    rate, turned = truth(k)
    in_time = sample.stamp_ns == k * PERIOD_NS and sample.received_ns == arrival(k)
    return (sample.angle_counts - turned) % 65536 == 0 and in_time and (sample.kind != wt931.SAMPLE or sample.rate_counts == rate)


def test_six_minutes_with_lost_bytes_bring_no_wrong_sample():
    found, sampler = replay(72_000, 0.001, 1)
    assert all(is_true(k, sample) for k, sample in found)
    assert len(found) > 0.97 * 72_000
    assert sampler.rejected > 100


def test_heavy_losses_bring_no_wrong_sample_either():
    found, _ = replay(20_000, 0.02, 5)
    assert all(is_true(k, sample) for k, sample in found)
    assert len(found) > 8_000


def test_without_losses_only_the_confirmation_costs_samples():
    found, sampler = replay(200, 0.0, 0)
    assert [k for k, _ in found] == list(range(wt931.CONFIRMATIONS - 1, 200))
    assert {s.kind for _, s in found} == {wt931.SAMPLE}
    assert sampler.rejected == 2 * (wt931.CONFIRMATIONS - 1)


def settled():
    sampler = wt931.Sampler(bounds(), BAUD)
    for k in range(5):
        sampler.feed(burst(k), arrival(k))
    return sampler


def test_a_burst_in_pieces_is_one_sample():
    sampler = settled()
    data = burst(5)
    for i in range(21):
        assert sampler.feed(data[i : i + 1], arrival(5) - serial_ns(21 - i, BAUD)) == []
    (sample,) = sampler.feed(data[21:], arrival(5))
    assert (sample.kind, sample.stamp_ns) == (wt931.SAMPLE, 5 * PERIOD_NS)


def test_samples_that_waited_for_the_reader_are_stamped_apart():
    one, two = settled().feed(burst(5) + burst(6), arrival(6))
    assert two.stamp_ns - one.stamp_ns == BURST_NS
    assert two.stamp_ns == 6 * PERIOD_NS


def test_a_rate_of_the_burst_before_is_not_paired_over_22_lost_bytes():
    sampler = settled()
    sampler.feed(burst(5)[:11], arrival(5) - serial_ns(11, BAUD))
    (sample,) = sampler.feed(burst(6)[11:], arrival(6))
    assert sample.kind == wt931.SAMPLE_WITHOUT_RATE


def test_a_lost_sum_byte_is_not_made_up_by_the_next_head():
    k = next(k for k in range(3, 10_000) if burst(k)[-1] == wt931.HEAD)
    sampler = wt931.Sampler(bounds(), BAUD)
    for i in range(k):
        sampler.feed(burst(i), arrival(i))
    assert sampler.feed(burst(k)[:-1], arrival(k) - serial_ns(1, BAUD)) == []
    found = sampler.feed(burst(k + 1), arrival(k + 1))
    assert all(is_true(k + 1, sample) for sample in found)
    assert is_true(k + 2, sampler.feed(burst(k + 2), arrival(k + 2))[0])


def test_a_packet_completed_by_the_next_burst_is_not_believed():
    sampler = settled()
    torn = burst(5)[:21]
    assert sampler.feed(torn, arrival(5)) == []
    before = sampler.rejected
    assert sampler.feed(burst(5)[21:], arrival(6) - serial_ns(21, BAUD)) == []
    assert sampler.rejected == before + 1
    assert sampler.feed(burst(6), arrival(6) + 1)[0].angle_counts == truth(6)[1]


def test_register_replies_are_kept_apart():
    sampler = settled()
    sampler.feed(wt931.encode_packet(wt931.REGISTERS, (12, 11, 6, 0)), arrival(5))
    assert sampler.registers == [(12, 11, 6, 0)]
