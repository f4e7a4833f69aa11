"""Inputs at lockstep pace, on a follower whose ticks are made here."""

from collections import deque
from types import SimpleNamespace

import pytest

from softloop.wire.lockstep import RigClock
from softloop.wire.lockstep_inputs import PacedBytes, PacedCommands, PacedFrames, PacedNewest, PacedRequests, PacedValveFrames
from softloop.wire.messages import constant, message
from softloop.wire.schedule import PERIOD_NS, START_NS, make_schedule

MS = 1_000_000
COMMAND, REQUEST = message("ValveCommand"), message("GateRequest")


class Pace:
    """A follower: `plan` gives the pieces of each tick, `said` the last command of each."""

    def __init__(self, plan=(), said=()):
        self.rig_clock = self.clock = RigClock()
        self.plan, self.said = list(plan), list(said)
        self.pieces, self.tick, self.over = deque(), None, False
        self.latency_ns, self.timeout_s, self.period_ns = 600_000, 0.2, PERIOD_NS
        self.board = SimpleNamespace(marks={}, wait_done=lambda process, ticks: True)
        self.taken = 0

    def pieces_of(self, wire):
        return self.pieces

    def interrupted(self):
        return False

    def next_tick(self):
        if self.taken == max(len(self.plan), len(self.said)):
            return False
        number = self.taken
        self.tick = SimpleNamespace(tick=number, stamp_ns=START_NS + number * PERIOD_NS, last=0)
        if self.plan:
            self.pieces.extend(self.plan[number])
        if self.said:
            self.board.marks["controller"] = SimpleNamespace(last_seq=self.said[number])
        if not self.pieces:
            self.rig_clock.set(self.tick.stamp_ns)
        self.taken += 1
        return True

    def end_with_this(self):
        pass

    def awaited(self, take, what):
        found = take(0.0)
        assert found is not None, what
        return found


class Source:
    """Gives what it was given, piece by piece."""

    def __init__(self, *items):
        self.items = deque(items)

    def read(self, timeout_s):
        return self.items.popleft() if self.items else b""

    def recv(self, timeout_s=0.0):
        return self.items.popleft() if self.items else None

    take = recv


def test_bytes_come_in_the_announced_pieces_whatever_the_port_gives():
    arrivals = [START_NS + 2 * MS, START_NS + 4 * MS, START_NS + 7 * MS]
    pace = Pace(plan=[[(3, arrivals[0]), (5, arrivals[1])], [(9, arrivals[2])], []])
    source = PacedBytes(pace, Source(b"a", b"bcdefg", b"hi"), 2)
    assert [(source.read(1.0), pace.clock.now_ns()) for _ in range(3)] == list(
        zip([b"abc", b"de", b"fghi"], arrivals, strict=True)
    )
    assert source.read(1.0) == b""
    assert pace.clock.now_ns() == START_NS + 2 * PERIOD_NS


def test_frames_are_taken_at_their_arrival_and_only_as_many_as_announced():
    pace = Pace(plan=[[], [(1, START_NS + 6 * MS)]])
    source = PacedFrames(pace, Source("first", "second"), 1)
    assert source.recv(0.0) is None  # who does not wait does not go on to the next tick
    assert pace.taken == 0
    assert source.recv(1.0) is None  # a tick without a frame
    assert source.recv(1.0) == "first"
    assert pace.clock.now_ns() == START_NS + 6 * MS
    assert source.recv(0.0) is None


def test_a_command_is_taken_the_softwares_latency_after_its_tick():
    pace = Pace(said=[0, 1, 2])
    queue = Source(("key", b"one"), ("key", b"two"))
    commands = PacedCommands(pace, queue)
    assert commands.take(0.005) is None  # tick 0, on which there is none
    assert commands.take(0.005) == ("key", b"one")
    assert pace.clock.now_ns() == START_NS + PERIOD_NS + 600_000
    assert commands.take(0.005) == ("key", b"two")


def test_a_tick_without_a_command_lets_the_gates_deadline_pass():
    pace = Pace(said=[1, 1, 2])
    commands = PacedCommands(pace, Source(("key", b"one"), ("key", b"two")))
    assert commands.take(0.005) == ("key", b"one")
    deadline_ns = pace.clock.now_ns() + PERIOD_NS + 1_500_000
    assert commands.take((deadline_ns - pace.clock.now_ns()) * 1e-9) is None
    assert pace.clock.now_ns() >= deadline_ns
    assert pace.clock.now_ns() < START_NS + 2 * PERIOD_NS
    assert commands.take(0.005) == ("key", b"two")


def test_requests_wait_for_their_stamp_and_a_stop_does_not():
    def request(action, stamp_ns):
        return "key", REQUEST.pack(REQUEST.make(seq=1, stamp_ns=stamp_ns, origin=1, action=constant("GateRequest", action)))

    pace = Pace()
    arm, stop = request("ACTION_ARM", START_NS + 10 * MS), request("ACTION_STOP", START_NS + 99 * MS)
    inbox = SimpleNamespace(received=3, waiting=[arm, stop, ("key", b"junk")])
    inbox.take_all = lambda: [inbox.waiting.pop(0) for _ in range(len(inbox.waiting))]
    requests = PacedRequests(pace, inbox)
    assert requests.take_all() == [stop, ("key", b"junk")]
    pace.rig_clock.set(START_NS + 10 * MS)
    assert requests.take_all() == [arm]
    assert requests.take_all() == []
    assert pace.requests_in() == 3


def test_the_newest_is_the_one_that_the_watermark_names():
    payloads = [COMMAND.pack(COMMAND.make(seq=n)) for n in (1, 2)]
    pace = Pace()
    newest = PacedNewest(pace, Source(*payloads), "controller")
    assert newest.take() is None  # nothing said yet
    pace.board.marks["controller"] = SimpleNamespace(last_seq=1)
    assert newest.take() == payloads[0]
    assert newest.take() is None
    pace.board.marks["controller"] = SimpleNamespace(last_seq=2)
    assert newest.take() == payloads[1]


def test_valve_frames_are_taken_at_their_end_on_the_wire_then_the_clock_goes_on():
    pace = Pace()
    pace.target_ns = START_NS + PERIOD_NS
    frames = PacedValveFrames(pace, Source("frame"), 270_000)
    assert frames.recv() is None
    pace.rig_clock.value_ns = START_NS
    pace.board.marks["valves"] = SimpleNamespace(sent=1, sent_stamp_ns=START_NS + 600_000)
    assert frames.recv() == "frame"
    assert pace.clock.now_ns() == START_NS + 870_000
    assert frames.recv() is None
    assert pace.clock.now_ns() == START_NS + PERIOD_NS


def test_a_clock_does_not_go_back():
    clock = RigClock()
    clock.set(START_NS + 5)
    clock.set(START_NS + 3)
    assert clock.now_ns() == START_NS + 5
    clock.sleep_until_ns(START_NS + 9)
    assert clock.now_ns() == START_NS + 9


@pytest.mark.parametrize(("vent_s", "ticks"), [(0.0, 301), (0.001, 302)])
def test_a_schedule_counts_every_tick_up_to_the_end(vent_s, ticks):
    schedule = make_schedule(0.5, 1.0, vent_s)
    assert (schedule.arm_ns - START_NS, schedule.disarm_ns - START_NS) == (500 * MS, 1500 * MS)
    assert schedule.ticks == ticks
