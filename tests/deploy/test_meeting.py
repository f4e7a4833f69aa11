"""What the absence of a shared meeting point excuses, and what not."""

import types

import pytest

from softloop.deploy import meeting as module
from softloop.deploy.meeting import EXCUSE_S, Meeting


class Now:
    def __init__(self):
        self.value = 100.0

    def monotonic(self):
        return self.value


@pytest.fixture
def world(monkeypatch):
    now = Now()
    monkeypatch.setattr(module, "time", now)
    routers, said, told = ["r"], [], []
    info = types.SimpleNamespace(routers_zid=lambda: list(routers))
    wire = types.SimpleNamespace(session=types.SimpleNamespace(info=info))
    made = Meeting(wire, watched=True, say=said.append, tell=lambda back, away_s: told.append((back, away_s)))
    return now, routers, said, told, made


def test_a_fault_of_its_own_is_not_excused(world):
    _, _, said, _, meeting = world
    meeting.look(None)
    meeting.look("sensor stale")
    assert not meeting.excuses
    assert not meeting.awaits_arming
    assert said == []


def test_loss_and_return_are_said_and_the_fault_waits_for_a_person(world):
    now, routers, said, told, meeting = world
    routers.clear()
    meeting.look(None)
    now.value += 3.0
    meeting.look("command silent")
    assert (meeting.away_s, meeting.excuses, meeting.awaits_arming) == (3.0, True, False)
    routers.append("another")
    meeting.look("command silent")
    assert (meeting.away_s, meeting.excuses, meeting.awaits_arming) == (0.0, True, True)
    assert told == [(False, 0.0), (True, 3.0)]
    assert said[0].startswith("the meeting point is lost")
    assert said[1] == "the meeting point is back after 3.0 s"
    assert "softloop request BENCH arm" in said[2]
    now.value += 10 * EXCUSE_S
    meeting.look("command silent")
    assert not meeting.excuses
    assert meeting.awaits_arming  # for as long as the person needs
    meeting.look(None)
    assert not meeting.awaits_arming
    meeting.look("over pressure")
    assert not meeting.awaits_arming  # this one has nothing to do with it
    assert len(said) == 3


def test_a_launcher_that_is_the_meeting_point_watches_nothing(world):
    _, routers, said, _, _ = world
    wire = types.SimpleNamespace(session=None)
    meeting = Meeting(wire, watched=False, say=said.append, tell=lambda back, away_s: None)
    routers.clear()
    meeting.look(None)
    assert (meeting.away_s, meeting.excuses, said) == (0.0, False, [])


def test_a_host_that_is_not_heard_for_a_while_excuses_a_fault_once_it_is_back(world):
    now, _, said, told, meeting = world
    meeting.look(None)
    meeting.look("not ready")
    assert not meeting.fault_counts(1.5)  # the silence of a host is known later than what it leads to
    assert meeting.fault_counts(0.0)
    now.value += 0.8
    meeting.look("not ready", [(1, "board")])
    assert (meeting.excuses, meeting.excuses_hosts, meeting.awaits_arming) == (True, False, False)
    now.value += 2.0
    assert not meeting.fault_counts(1.5)
    meeting.look("not ready")
    assert meeting.awaits_arming
    assert said[:2] == [
        "host 'board' is not heard; the run goes on if it is back soon",
        "host 'board' is heard again after 2.0 s",
    ]
    assert told == []
    meeting.look(None)
    now.value += 10 * EXCUSE_S
    meeting.look("over pressure")
    now.value += 1.5
    meeting.look("over pressure")
    assert meeting.fault_counts(1.5)
