"""The relay's queue: what a seed decides, in which order and when packets come out."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.net.cable import LIMIT, Cable, Way
from tests.net.relay import Relay, direction_of

MS = 1_000_000
WAYS = st.builds(Way, delay_ms=st.floats(0, 50), jitter_ms=st.floats(0, 50), loss=st.floats(0, 1))
ARRIVALS = st.lists(st.integers(0, 20 * MS), max_size=60).map(lambda gaps: [sum(gaps[: k + 1]) for k in range(len(gaps))])


def sent(cable, arrivals):
    """Number -> ns under way of the packets that came through, each taken out the moment that it was due."""
    out = []
    for number, at_ns in enumerate(arrivals):
        cable.put(number.to_bytes(4, "big"), at_ns)
        while cable.next_ns is not None and cable.next_ns <= at_ns:
            out += cable.take(at_ns)
    while cable.next_ns is not None:
        out += cable.take(cable.next_ns)
    return [(int.from_bytes(packet, "big"), due_ns) for due_ns, packet in out]


@given(WAYS, st.integers(0, 2**32), ARRIVALS)
def test_order_is_kept_none_is_early_and_all_are_accounted_for(way, seed, arrivals):
    cable = Cable(way, seed)
    out = sent(cable, arrivals)
    assert [number for number, _ in out] == sorted({number for number, _ in out})
    for number, due_ns in out:
        assert due_ns - arrivals[number] >= way.delay_ms * MS - 1
    assert cable.put_in == len(arrivals) == cable.passed + cable.lost + cable.overrun
    assert cable.passed == len(out)


@given(st.floats(0, 1), st.integers(0, 2**32), ARRIVALS, ARRIVALS)
def test_which_packets_are_lost_follows_from_the_seed_whenever_they_come(loss, seed, some, others):
    n = min(len(some), len(others))
    first, second = (sent(Cable(Way(3.0, 2.0, loss), seed, "a>b"), arrivals[:n]) for arrivals in (some, others))
    assert [number for number, _ in first] == [number for number, _ in second]


def test_directions_and_seeds_lose_different_packets_at_the_rate_that_is_asked_for():
    arrivals = range(0, 20_000 * MS, MS)
    lost = {}
    for seed, direction in ((1, "a>b"), (1, "b>a"), (2, "a>b")):
        cable = Cable(Way(loss=0.05), seed, direction)
        through = {number for number, _ in sent(cable, arrivals)}
        lost[seed, direction] = set(range(len(arrivals))) - through
        assert cable.lost == len(lost[seed, direction]) == pytest.approx(1000, abs=125)  # four deviations
    assert len({frozenset(one) for one in lost.values()}) == 3


def test_jitter_is_even_and_one_late_packet_holds_those_behind_it():
    spread = [due_ns - 10 * MS * number for number, due_ns in sent(Cable(Way(1.0, 4.0), 1), range(0, 40_000 * MS, 10 * MS))]
    assert 1.0 * MS <= min(spread) < 1.1 * MS
    assert 4.9 * MS < max(spread) <= 5.0 * MS
    assert sum(spread) / len(spread) == pytest.approx(3.0 * MS, rel=0.05)
    dues = [due_ns for _, due_ns in sent(Cable(Way(1.0, 50.0), 1), [0] * 100)]
    assert dues == sorted(dues)


def test_a_full_cable_drops_what_comes_and_counts_it():
    cable = Cable(Way(delay_ms=10.0), 1)
    for _ in range(LIMIT + 7):
        cable.put(b"x", 0)
    assert cable.overrun == 7
    assert len(cable.take(10 * MS)) == LIMIT
    assert cable.next_ns is None


@pytest.mark.parametrize("wrong", [{"loss": 1.1}, {"loss": -0.1}, {"delay_ms": -1.0}, {"jitter_ms": 1e9}, {"loss": float("nan")}])
def test_what_no_cable_does_is_refused(wrong):
    with pytest.raises(ValueError, match="must be between"):
        Way(**wrong)


def ipv4(source, destination):
    return struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20, 0, 0, 64, 6, 0, bytes(source), bytes(destination))


@given(st.binary(max_size=40))
def test_any_bytes_have_a_direction_or_none(packet):
    direction = direction_of(packet)
    assert (direction is None) == (len(packet) < 20 or packet[0] >> 4 != 4)


def test_each_direction_is_a_cable_of_its_own_and_the_kernels_own_packets_are_none():
    relay = Relay(Way(delay_ms=1.0), seed=1)
    relay.put(ipv4((10, 77, 1, 2), (10, 77, 2, 2)), 0)
    relay.put(ipv4((10, 77, 2, 2), (10, 77, 1, 2)), MS // 2)
    relay.put(b"\x60" + bytes(39), 0)
    assert list(relay.cables) == ["10.77.1.2>10.77.2.2", "10.77.2.2>10.77.1.2"]
    assert relay.next_ns == MS
    assert [due_ns for due_ns, _ in relay.take(2 * MS)] == [MS, 3 * MS // 2]
    assert relay.next_ns is None
    assert relay.counts()["directions"]["10.77.1.2>10.77.2.2"] == {"put_in": 1, "lost": 0, "overrun": 0, "passed": 1}
