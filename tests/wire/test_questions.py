"""Questions: who asks hears the answer, waits for one who has only just begun to answer, and is told where nobody does."""

import threading
import time

import pytest

from softloop.wire import questions
from softloop.wire.channels import FAULT
from softloop.wire.errors import BadConfig, Unavailable
from softloop.wire.questions import BECOMING_KNOWN_S, WAITING_MAX, Questions, ask
from tests.wire.rendezvous import two_wires


def answer_after(wire, delay_s, stop, answered):
    """Begin to answer after a while: refuse `no`, grant all else, until told to stop."""
    time.sleep(delay_s)
    answers = Questions(wire, FAULT)
    while not stop.wait(0.005):
        for question in answers.take_all():
            answered.append(question.payload)
            question.refuse("not\nthis one") if question.payload == b"no" else question.accept()


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_one_who_begins_to_answer_while_asked_is_found_and_asked_once(mode, monkeypatch):
    monkeypatch.setattr(questions, "BECOMING_KNOWN_S", 10.0)
    stop, answered = threading.Event(), []
    with two_wires(mode) as (asks, answers):
        for wire in (asks, answers):
            wire.settle(lambda: False)
        thread = threading.Thread(target=answer_after, args=(answers, 0.3, stop, answered))
        thread.start()
        try:
            ask(asks, FAULT, b"yes", 10.0)
            with pytest.raises(BadConfig, match=r"^not this one$"):
                ask(asks, FAULT, b"no", 10.0)
        finally:
            stop.set()
            thread.join(10.0)
    assert answered == [b"yes", b"no"]


def test_where_nobody_answers_it_is_said_soon():
    with two_wires("client") as (asks, _):
        before = time.monotonic()
        with pytest.raises(Unavailable, match="nothing of bench 'test' answers on 'fault'"):
            ask(asks, FAULT, b"yes", 60.0)
        assert time.monotonic() - before >= BECOMING_KNOWN_S


def test_more_than_can_wait_are_refused():
    with two_wires("client") as (asks, answers):
        for wire in (asks, answers):
            wire.settle(lambda: False)
        taker = Questions(answers, FAULT)
        outcomes = []

        def ask_one():
            try:
                ask(asks, FAULT, b"yes", 20.0)
            except BadConfig as error:
                outcomes.append(str(error))
            else:
                outcomes.append("done")

        threads = [threading.Thread(target=ask_one) for _ in range(WAITING_MAX + 1)]
        for thread in threads:
            thread.start()
        end = time.monotonic() + 15.0
        while not outcomes and time.monotonic() < end:
            time.sleep(0.01)
        assert outcomes == [f"{WAITING_MAX} requests are waiting already"]
        taken = taker.take_all()
        for question in taken:
            question.accept()
        for thread in threads:
            thread.join(20.0)
        assert len(taken) == WAITING_MAX
        assert outcomes.count("done") == WAITING_MAX
