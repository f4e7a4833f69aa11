from hypothesis import given
from hypothesis import strategies as st

from softloop.wire.clock import Deadlines, WallClock

PERIOD = 5_000_000


def test_deadlines_in_time_skip_nothing():
    deadlines = Deadlines(PERIOD, 100)
    for tick in range(10):
        assert (deadlines.tick, deadlines.next_ns, deadlines.skipped) == (tick, 100 + tick * PERIOD, 0)
        deadlines.advance(deadlines.next_ns + PERIOD - 1)


@given(st.lists(st.integers(0, 20 * PERIOD), max_size=40))
def test_after_an_overrun_the_next_deadline_lies_ahead_and_skips_are_counted(durations):
    deadlines, now = Deadlines(PERIOD, 0), 0
    for duration in durations:
        now = max(now, deadlines.next_ns) + duration
        before = deadlines.next_ns
        deadlines.advance(now)
        assert deadlines.next_ns > now - PERIOD  # at most the one deadline that is just due
        assert deadlines.next_ns == before + (1 + deadlines.skipped) * PERIOD
        assert deadlines.next_ns == deadlines.tick * PERIOD
    assert deadlines.tick == len(durations) + deadlines.skipped_total


def test_an_overrun_of_three_and_a_half_periods_skips_three():
    deadlines = Deadlines(PERIOD, 0)
    deadlines.advance(PERIOD // 2 + 3 * PERIOD)
    assert (deadlines.skipped, deadlines.next_ns) == (3, 4 * PERIOD)


def test_the_wall_clock_does_not_wake_early():
    clock = WallClock()
    deadline = clock.now_ns() + 3_000_000
    clock.sleep_until_ns(deadline)
    assert clock.now_ns() >= deadline
    clock.sleep_until_ns(deadline - 10**9)  # the past: returns at once
