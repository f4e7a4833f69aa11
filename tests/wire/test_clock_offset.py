"""The stated uncertainty of a clock's offset holds: under drift, steps, jitter, losses and ways of unequal length."""

import random
from dataclasses import dataclass

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softloop.wire.clock_config import ClockConfig
from softloop.wire.clock_offset import Exchange, OffsetEstimator
from softloop.wire.host_clock import SNAP_NS, Follower, HostClock
from softloop.wire.messages import message

MS, S = 1_000_000, 1_000_000_000
PERIOD_NS = 100 * MS
CONFIG = ClockConfig()


@dataclass
class World:
    """Two clocks and a network. The own clock is the world's time; the reference clock is offset, drifts and steps."""

    seed: int
    offset_ns: int = 0
    drift_ppm: float = 0.0
    there_us: float = 200.0
    back_us: float = 200.0
    jitter_us: float = 50.0
    step_ns: int = 0
    step_at_s: float = 1e9

    def __post_init__(self):
        self.random = random.Random(self.seed)

    def true_offset_ns(self, at_ns):
        step_ns = self.step_ns if at_ns >= self.step_at_s * S else 0
        return self.offset_ns + round(at_ns * self.drift_ppm * 1e-6) + step_ns

    def way_ns(self, base_us):
        rare_us = self.random.expovariate(1 / 5000.0) if self.random.random() < 0.05 else 0.0
        return round((base_us + self.random.expovariate(1.0) * self.jitter_us + rare_us) * 1000)

    def exchange(self, at_ns):
        heard_ns = at_ns + self.way_ns(self.there_us)
        replied_ns = heard_ns + 20_000
        answered_ns = replied_ns + self.way_ns(self.back_us)
        return Exchange(
            at_ns, heard_ns + self.true_offset_ns(heard_ns), replied_ns + self.true_offset_ns(replied_ns), answered_ns
        )


WORLDS = st.builds(
    World,
    seed=st.integers(0, 2**32),
    offset_ns=st.integers(-(10**15), 10**15),
    drift_ppm=st.floats(-100.0, 100.0),
    there_us=st.floats(20.0, 5000.0),
    back_us=st.floats(20.0, 5000.0),
    jitter_us=st.floats(0.0, 1000.0),
    step_ns=st.sampled_from([0, 0, 300_000, -2 * MS, 20 * MS, -S, 3600 * S]),
    step_at_s=st.floats(5.0, 40.0),
)


def run(world, seconds=60, lost=0.1):
    """Follow a world; per exchange whether the true offset lay inside, worst just before the next one, and what was found."""
    follower = Follower(CONFIG, 0)
    clock = HostClock(0, lambda: run.now_ns)
    inside, changes = [], []
    for k in range(1, seconds * S // PERIOD_NS):
        at_ns = k * PERIOD_NS
        run.now_ns = at_ns
        if follower.estimator.known:
            error_ns = abs(clock.now_ns() - at_ns - world.true_offset_ns(at_ns))
            inside.append((at_ns, error_ns <= follower.uncertainty_ns(at_ns)))
        if world.random.random() < lost:
            continue
        exchange = world.exchange(at_ns)
        run.now_ns = exchange.answered_ns
        changes.append((at_ns, follower.learn(exchange)))
        clock.take(follower.word(exchange.answered_ns))
    return follower, inside, changes


def share(inside):
    return sum(good for _, good in inside) / len(inside)


@settings(max_examples=30)
@given(WORLDS)
def test_the_true_offset_is_inside_the_stated_uncertainty(world):
    _, inside, _ = run(world)
    assert share(inside) >= 0.95, share(inside)


@settings(max_examples=30)
@given(WORLDS)
def test_clocks_that_keep_to_their_word_are_never_outside(world):
    world.step_ns = 0
    _, inside, changes = run(world)
    assert share(inside) == 1.0
    assert not any(change.step_ns or change.drifts for _, change in changes)


@pytest.mark.parametrize("step_ns", [5 * MS, -20 * MS, S, -3600 * S])
def test_a_step_is_found_within_a_second_and_measured(step_ns):
    world = World(3, drift_ppm=30.0, step_ns=step_ns, step_at_s=20.0)
    follower, _, changes = run(world)
    (at_ns, change), *more = [(at, change) for at, change in changes if change.step_ns]
    assert not more
    assert 20 * S <= at_ns <= 21 * S
    assert change.step_ns == pytest.approx(step_ns, abs=MS)
    assert follower.estimator.steps == 1


@pytest.mark.parametrize("drift_ppm", [300.0, -800.0])
def test_clocks_that_run_apart_too_fast_are_found_once_and_the_bound_holds_again(drift_ppm):
    world = World(4, drift_ppm=drift_ppm)
    follower, inside, changes = run(world)
    found = [at for at, change in changes if change.drifts]
    assert len(found) == 1
    assert found[0] < 20 * S
    assert share([(at, good) for at, good in inside if at > found[0] + S]) >= 0.95
    known = follower.estimator.at(60 * S)
    assert abs(known.drift_ppm - drift_ppm) <= known.drift_error_ppm


def test_a_long_way_in_one_direction_alone_is_inside_and_not_an_event():
    world = World(5, there_us=5000.0, back_us=20.0, jitter_us=0.0)
    follower, inside, changes = run(world)
    assert share(inside) == 1.0
    known = follower.estimator.at(60 * S)
    assert known.offset_ns == pytest.approx(2.49 * MS, abs=0.3 * MS)  # as wrong as the ways are unequal
    assert known.uncertainty_ns >= 2.5 * MS
    assert not any(change.step_ns or change.drifts for _, change in changes)


def test_impossible_exchanges_are_left_out():
    estimator = OffsetEstimator(100.0, MS)
    for impossible in (Exchange(10, 0, 50, 20), Exchange(10, 5, 4, 20), Exchange(10, 0, 0, 9)):
        estimator.add(impossible)
    assert not estimator.known
    assert estimator.exchanges == 0


def test_the_uncertainty_grows_while_nobody_answers():
    estimator = OffsetEstimator(100.0, MS)
    estimator.add(Exchange(0, 1000, 1000, 2000))
    assert estimator.at(2000).uncertainty_ns < 3000
    assert estimator.at(10 * S).uncertainty_ns == pytest.approx(1 * MS, rel=0.01)  # 10 s at 100 ppm


def test_a_clock_that_is_led_never_runs_backward_and_takes_a_jump_at_once():
    now = [0]
    clock = HostClock(2, lambda: now[0])
    clock.set(10 * S)
    before = clock.now_ns()
    clock.set(10 * S - 300_000)
    for step in range(400):
        now[0] += MS
        assert clock.now_ns() > before, step
        before = clock.now_ns()
    assert clock.now_ns() - now[0] == 10 * S - 300_000
    clock.set(10 * S - SNAP_NS - 400_000)
    assert clock.now_ns() - now[0] == 10 * S - SNAP_NS - 400_000


def test_a_host_clock_takes_the_word_on_its_own_host_alone():
    clock = HostClock(1, lambda: 0)
    kind = message("ClockOffset")
    clock.take(kind.pack(kind.make(host=0, offset_ns=5)))
    clock.take(b"nothing")
    assert not clock.known
    clock.take(kind.pack(kind.make(host=1, offset_ns=7)))
    assert (clock.known, clock.now_ns()) == (True, 7)


def test_an_exchange_that_waited_long_makes_nothing_forgotten():
    """Its middle is far off where it waited on one way alone, and the first ones did not go the shortest way either."""
    estimator = OffsetEstimator(100.0, MS)
    estimator.add(Exchange(0, 1 * MS, 1 * MS, 1 * MS + 10_000))
    assert estimator.at(2 * MS).uncertainty_ns < 0.6 * MS
    estimator.add(Exchange(100 * MS, 100 * MS + 10_000, 100 * MS + 10_000, 120 * MS))
    assert estimator.at(121 * MS).uncertainty_ns < 0.6 * MS
