"""The bus in time: bits, arbitration, errors, bus-off and back, load."""

import itertools

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.devices.protocols.wire_time import can_frame_ns
from softloop.wire import can_bits, can_errors
from softloop.wire.can_bus import CanBus
from softloop.wire.can_errors import ErrorCounters, NodeState
from softloop.wire.can_frame import ERROR_BUS_OFF, FLAG_ERROR, FLAG_EXTENDED, FLAG_REMOTE, from_message, make_frame, state_after

RATE = 500_000
BIT_NS = 1_000_000_000 // RATE
FRAME = make_frame(1, 0, 1, 0x80, bytes(range(8)))


def frame(arbitration_id=0x100, data=b"\x12\x34", flags=0, seq=1):
    return make_frame(seq, 0, 1, arbitration_id, data, flags)


# --- bits ---------------------------------------------------------------------------------------------------------------------


def test_lengths_without_any_stuffing():
    # 0x555 and alternating data need few stuff bits; 44 + 8 n bits and 3 of interframe space without them.
    for n in range(9):
        data = frame(0x555, bytes([0x55] * n))
        bits = can_bits.header_and_data(data)
        assert len(bits) == 19 + 8 * n
        stuffed = can_bits.stuff_bits(bits + [(can_bits.crc15(bits) >> k) & 1 for k in range(14, -1, -1)])
        assert can_bits.frame_bits(data) == 47 + 8 * n + stuffed
    assert len(can_bits.header_and_data(frame(0x1555_5555, b"", FLAG_EXTENDED))) == 39


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_exact_length_is_never_more_than_the_worst_case_and_never_less_than_unstuffed(arbitration_id, data):
    bits = can_bits.frame_bits(frame(arbitration_id, data))
    assert 47 + 8 * len(data) <= bits
    assert bits * BIT_NS <= can_frame_ns(len(data), RATE)


def destuffed(bits):
    """Bits with the stuffing put in and taken out again, and the number put in, by another way than the code's."""
    sent, run = [], []
    for bit in bits:
        sent.append(bit)
        run = [*run, bit] if run and run[-1] == bit else [bit]
        if len(run) == 5:
            sent.append(1 - bit)
            run = [1 - bit]
    assert all(len({*sent[k : k + 6]}) == 2 for k in range(len(sent) - 5)), "six alike on the wire are an error"
    return len(sent) - len(bits)


@given(st.lists(st.integers(0, 1), max_size=120))
def test_stuffing(bits):
    assert can_bits.stuff_bits(bits) == destuffed(bits)


@given(st.lists(st.integers(0, 1), min_size=1, max_size=100))
def test_the_checksum_is_the_remainder_of_a_division_of_polynomials(bits):
    value = int("".join(map(str, bits)), 2) << 15
    for k in range(value.bit_length() - 1, 14, -1):
        if value >> k & 1:
            value ^= (0x8000 | 0x4599) << (k - 15)
    assert can_bits.crc15(bits) == value


def test_arbitration_is_what_the_bits_say():
    """The frame whose first differing bit is dominant wins, over standard and extended, data and remote frames."""
    frames = [frame(i, b"", f) for i in (0, 0x100, 0x101, 0x7FF) for f in (0, FLAG_REMOTE)]
    frames += [
        frame(i << 18 | low, b"", FLAG_EXTENDED | f) for i in (0, 0x100, 0x7FF) for low in (0, 5) for f in (0, FLAG_REMOTE)
    ]
    by_bits = sorted(frames, key=can_bits.header_and_data)
    assert sorted(frames, key=can_bits.arbitration_rank) == by_bits


# --- the bus ------------------------------------------------------------------------------------------------------------------


def bus_of(n=3, **options):
    bus = CanBus(RATE, **options)
    for node in range(1, n + 1):
        bus.join(node)
    return bus


def heard(deliveries, node):
    return [d.frame.arbitration_id for d in deliveries if d.node == node and not d.own and not d.frame.flags & FLAG_ERROR]


def test_a_frame_arrives_at_its_exact_end_at_all_others():
    bus = bus_of()
    assert bus.send(1, FRAME, 1000)
    end_ns = 1000 + can_bits.frame_bits(FRAME) * BIT_NS
    assert bus.run_until(end_ns - 1) == []
    found = bus.run_until(end_ns)
    assert {(d.node, d.own, d.end_ns) for d in found} == {(1, True, end_ns), (2, False, end_ns), (3, False, end_ns)}


def test_the_lower_identifier_goes_first_and_a_frame_under_way_is_not_broken_off():
    bus = bus_of(3)
    bus.send(1, frame(0x300), 0)
    bus.send(2, frame(0x200), 10)  # the first is under way
    bus.send(2, frame(0x050), 10)  # stays behind the one before it in its own queue
    bus.send(3, frame(0x100), 20)
    assert [*heard(bus.run_until(10**9), 1), 768] == [0x100, 0x200, 0x050, 0x300]
    bus.send(1, frame(0x300), 2 * 10**9)
    bus.send(3, frame(0x100), 2 * 10**9)
    assert heard(bus.run_until(3 * 10**9), 2) == [0x100, 0x300]


@given(st.lists(st.tuples(st.integers(1, 4), st.integers(0, 0x7FF), st.integers(0, 5_000_000)), max_size=40), st.integers(1, 30))
def test_frames_neither_overlap_nor_get_lost_however_often_one_looks(sends, looks):
    bus, ends = bus_of(4), []
    for node, arbitration_id, at_ns in sorted(sends, key=lambda s: s[2]):
        ends += bus.run_until(at_ns)
        bus.send(node, frame(arbitration_id), at_ns)
    for k in range(looks + 1):
        ends += bus.run_until(5_000_000 + k * 20_000_000 // looks)
    own = [d for d in ends if d.own]
    assert len(own) == len(sends)
    for before, after in itertools.pairwise(own):
        assert after.end_ns - before.end_ns >= can_bits.frame_bits(after.frame) * BIT_NS


def test_a_disturbed_frame_is_sent_again_and_the_counters_say_so():
    bus = bus_of()
    bus.disturb()
    bus.send(1, FRAME, 0)
    found = bus.run_until(10**9)
    assert heard(found, 2) == [0x80]
    assert bus.disturbed == 1
    assert bus.counters(1) == (7, 0)  # 8 for the error, 1 back for the frame that got out
    assert bus.counters(2) == (0, 0)
    errors = [d.frame for d in found if d.frame.flags & FLAG_ERROR]
    assert [e.arbitration_id & 0x1FF for e in errors] == [can_errors.ERROR_PROTOCOL | can_errors.ERROR_BUS]
    assert errors[0].data[6] == 8


def test_the_way_to_bus_off_and_back():
    bus = bus_of(2)
    states = []
    bus.disturb(32)
    bus.send(1, FRAME, 0)
    for k in range(1, 200):
        bus.run_until(k * 100_000)
        if not states or states[-1] != bus.state(1):
            states.append(bus.state(1))
    assert states == [NodeState.ACTIVE, NodeState.WARNING, NodeState.PASSIVE, NodeState.BUS_OFF]
    assert not bus.send(1, FRAME, 20_000_000)
    assert bus.send(2, FRAME, 20_000_000)
    assert heard(bus.run_until(30_000_000), 1) == [], "who is off the bus hears nothing"
    assert bus.unacknowledged > 0, "and acknowledges nothing"
    bus.restart(1, 40_000_000)
    back_ns = 40_000_000 + 128 * 11 * BIT_NS
    bus.run_until(back_ns - 1)
    assert bus.state(1) == NodeState.BUS_OFF
    found = bus.run_until(back_ns + 1_000_000)
    assert bus.state(1) == NodeState.ACTIVE
    assert bus.counters(1)[0] == 0
    assert heard(found, 1) == [0x80], "the frame that nobody acknowledged is still there"


def test_alone_on_a_bus_a_node_gets_passive_and_no_worse():
    bus = bus_of(1)
    bus.send(1, FRAME, 0)
    bus.run_until(10**9)
    assert bus.state(1) == NodeState.PASSIVE
    assert bus.counters(1) == (128, 0)
    bus.join(2)
    assert heard(bus.run_until(2 * 10**9), 2) == [0x80]


def test_a_node_restarts_by_itself_when_told_so():
    bus = bus_of(2, restart_ns=5_000_000)
    bus.disturb(32)
    bus.send(1, FRAME, 0)
    kinds = [d.frame.arbitration_id & 0x1FF for d in bus.run_until(10**9) if d.node == 1 and d.frame.flags & FLAG_ERROR]
    assert kinds[-2:] == [ERROR_BUS_OFF, 0x100]
    assert bus.state(1) == NodeState.ACTIVE


def test_receivers_count_by_one_and_come_back():
    counters = ErrorCounters()
    for _ in range(200):
        counters.receive_failed()
    assert counters.state == NodeState.PASSIVE
    counters.received()
    assert (counters.receive, counters.state) == (127, NodeState.WARNING)


def test_load_is_the_share_of_busy_time():
    bus = bus_of(2)
    for k in range(200):
        bus.send(1, FRAME, k * 5_000_000)
        bus.run_until((k + 1) * 5_000_000 - 1)
    assert bus.load(10**9) == pytest.approx(200 * can_bits.frame_bits(FRAME) / RATE, rel=1e-9)
    assert bus.load(3 * 10**9) == 0.0


def test_chance_is_of_the_seed():
    def run(seed):
        bus = bus_of(2, error_rate=0.2, seed=seed, queue=300)
        for k in range(300):
            bus.send(1, FRAME, k * 1_000_000)
        return bus.run_until(10**9), bus.disturbed

    assert run(3) == run(3)
    assert run(3)[1] != run(4)[1]
    assert 30 < run(3)[1] < 130


# --- as an adapter sees it ----------------------------------------------------------------------------------------------------


@pytest.fixture
def pair():
    nodes = [can.Bus(interface="emulated", channel="pair", bitrate=RATE, ignore_config=True) for _ in range(2)]
    yield nodes
    for node in nodes:
        node.shutdown()


def test_two_nodes_of_a_process(pair):
    one, other = pair
    one.send(can.Message(arbitration_id=0x80, is_extended_id=False, data=bytes(range(8))))
    got = other.recv(1.0)
    assert (got.arbitration_id, bytes(got.data)) == (0x80, bytes(range(8)))
    assert one.recv(0.0) is None
    assert 0.0 < one.load() < 0.1


def test_bus_off_is_an_error_frame_and_no_frame_gets_out(pair):
    one, other = pair
    one.emulation.disturb(32)
    one.send(can.Message(arbitration_id=0x80, is_extended_id=False, data=bytes(8)))
    state, seen = can.BusState.ACTIVE, []
    while (message := one.recv(0.2)) is not None:
        assert message.is_error_frame
        state = state_after(state, from_message(message, 1, 1, 1))
        seen.append(state)
    assert state == can.BusState.ERROR
    assert can.BusState.PASSIVE in seen
    with pytest.raises(can.CanOperationError, match="off the bus"):
        one.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    one.restart()
    assert one.recv(1.0).arbitration_id & 0x100
    one.send(can.Message(arbitration_id=0x81, is_extended_id=False))
    assert other.recv(1.0).arbitration_id == 0x81
