"""The clock exchange over real sessions: who asks learns the other's clock within the stated uncertainty."""

import shutil
import tempfile
import threading
import time
from pathlib import Path

import pytest

from softloop.wire.channels import CLOCK, time_key
from softloop.wire.clock_config import ClockConfig
from softloop.wire.config import ZenohConfig
from softloop.wire.errors import Unavailable
from softloop.wire.host_clock import Follower, HostClock, TimeQuestion, TimeServer
from softloop.wire.session import Wire, open_router, open_session

AHEAD_NS = 3_600_000_000_000


class Shifted:
    """This machine's clock, an hour ahead."""

    def __init__(self, ahead_ns=AHEAD_NS):
        self.ahead_ns = ahead_ns

    def now_ns(self):
        return time.monotonic_ns() + self.ahead_ns

    def sleep_until_ns(self, deadline_ns):
        raise NotImplementedError


@pytest.fixture(params=["peer", "client"])
def wires(request):
    """Two processes on a bench, in both modes."""
    folder = Path(tempfile.mkdtemp(prefix="sl-"))
    config = ZenohConfig(mode=request.param, endpoint=f"unixsock-stream/{folder}/m.sock")
    with open_router(config, "b"), open_session(config, "b", "one") as one, open_session(config, "b", "two") as two:
        wires = Wire(one, "b", "one"), Wire(two, "b", "two")
        for wire in wires:
            wire.settle(lambda: False)
        yield wires
    shutil.rmtree(folder)


def asked(question, patience_s=10.0):
    end = time.monotonic() + patience_s
    while (exchange := question.ask()) is None:
        assert time.monotonic() < end, "nobody answers"
    return exchange


def test_the_true_offset_is_inside_over_a_real_network(wires):
    server, client = wires
    clock = Shifted()
    kept = TimeServer(server, clock)
    question, follower = TimeQuestion(client), Follower(ClockConfig(), 0)
    for _ in range(50):
        follower.learn(asked(question))
        now_ns = time.monotonic_ns()
        assert abs(follower.offset_ns - AHEAD_NS) <= follower.uncertainty_ns(now_ns)
    known = follower.estimator.at(time.monotonic_ns())
    assert follower.estimator.exchanges == 50
    assert 0 < known.delay_ns < 1_000_000_000
    clock.ahead_ns += 2_000_000_000  # a jump of 2 s, far above any round trip here
    steps = [follower.learn(asked(question)).step_ns for _ in range(5)]
    assert sum(1 for step in steps if step) == 1
    assert kept is not None


def test_nobody_who_answers_is_nothing_known(wires):
    _, client = wires
    assert TimeQuestion(client).ask(0.2) is None


def test_two_who_answer_are_no_answer(wires):
    one, two = wires
    kept = TimeServer(one, Shifted()), TimeServer(two, Shifted(0))
    time_s = time.monotonic() + 10.0
    while TimeQuestion(two).ask(0.5) is not None:  # the other one's is known here only after a while
        assert time.monotonic() < time_s
    assert kept


def test_a_broken_answer_is_no_answer(wires):
    server, client = wires

    def answer(query):
        with query:
            query.reply(query.key_expr, b"noon")

    queryable = server.session.declare_queryable(time_key("b"), answer)
    end = time.monotonic() + 1.0
    while time.monotonic() < end:
        assert TimeQuestion(client).ask(0.2) is None
    queryable.undeclare()


def test_a_process_follows_its_launchers_word(wires):
    launcher, process = wires
    clock = HostClock(1)
    clock.listen(process)
    with pytest.raises(Unavailable, match="nothing is heard of this host's clock"):
        clock.wait_known(lambda: False, 0.1)
    over = threading.Event()
    follower, kept = Follower(ClockConfig(), 1), TimeServer(launcher, Shifted())

    def speak():
        put, question = launcher.publisher(CLOCK), TimeQuestion(process)
        while not over.wait(0.02):
            exchange = question.ask()
            if exchange is not None:
                follower.learn(exchange)
                put(follower.word(time.monotonic_ns()))

    speaker = threading.Thread(target=speak)
    speaker.start()
    try:
        clock.wait_known(lambda: False)
        error_ns = abs(clock.now_ns() - time.monotonic_ns() - AHEAD_NS)
        assert error_ns < 1_000_000_000
        before = clock.now_ns()
        for _ in range(2000):
            assert clock.now_ns() >= before
            before = clock.now_ns()
        due_ns = clock.now_ns() + 20_000_000
        clock.sleep_until_ns(due_ns)
        assert clock.now_ns() >= due_ns - 1_000_000  # an hour ahead, and still awake in time
    finally:
        over.set()
        speaker.join()
    assert kept is not None


def test_asked_to_stop_nobody_waits_for_the_clock():
    HostClock(1).wait_known(lambda: True, 60.0)
