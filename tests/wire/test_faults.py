"""Injections in the wires of a process: frames, a port that is off the bus, bytes, samples and their values."""

import math
from random import Random
from types import SimpleNamespace

import pytest

from softloop.wire.can_frame import ERROR_BUS_OFF, ERROR_CONTROLLER, ERROR_RESTARTED, FLAG_ERROR, make_frame
from softloop.wire.channels import INCLINATION, PRESSURE
from softloop.wire.fault_config import InjectionConfig
from softloop.wire.fault_line import Strike
from softloop.wire.faults import FaultyBytes, FaultyFrames, FaultySender, SteppedClock, spoiled_put
from softloop.wire.messages import message

MS = 1_000_000
SAMPLE = message("PressureSample")


def strike(kind, target, seed=3, at_s=0.05, duration_s=0.05, **more):
    config = InjectionConfig(kind=kind, target=target, at_s=at_s, duration_s=duration_s, **more)
    return Strike(config, Random(seed), lambda: 0, lambda *_: None)


class Rig:
    """A clock, a source of a frame or ten bytes every 5 ms, and a port that notes what it is told and given."""

    def __init__(self):
        self.now, self.waiting, self.noted, self.sent, self.extra, self.n = 0, [], [], [], [], 0

    def now_ns(self):
        return self.now

    def tick(self):
        self.n += 1
        self.now = 5 * MS * self.n
        self.waiting.append(make_frame(self.n, self.now, 7, 0x80, bytes([self.n % 256] * 8)))

    def recv(self, timeout_s=0.0):
        return self.waiting.pop(0) if self.waiting else None

    def read(self, timeout_s):
        return bytes(self.recv().data)

    def note(self, frame):
        self.noted.append(frame)

    def send(self, arbitration_id, data, stamp_ns):
        self.sent.append((arbitration_id, data, stamp_ns))
        return True


def frames_of(*strikes, timeout_s=0.0, ticks=30):
    rig, got = Rig(), []
    wire = FaultyFrames(rig, rig, rig.now_ns, list(strikes))
    for _ in range(ticks):
        rig.tick()
        while (frame := wire.recv(timeout_s)) is not None:
            got.append(frame)
            if timeout_s:
                break
    return rig, got


@pytest.mark.parametrize("timeout_s", [0.0, 0.05])
def test_frames_are_lost_while_it_lasts(timeout_s):
    _, got = frames_of(strike("can_drop", "analog"), timeout_s=timeout_s)
    assert [frame.seq for frame in got] == [*range(1, 10), *range(20, 31)]


def test_a_spoiled_frame_differs_in_as_many_bits_and_in_nothing_else():
    _, got = frames_of(strike("can_corrupt", "analog"))
    spoiled = [frame for frame in got if frame.data != bytes([frame.seq] * 8)]
    assert [frame.seq for frame in spoiled] == list(range(10, 20))
    for frame in spoiled:
        assert sum((a ^ frame.seq).bit_count() for a in frame.data) == 1
        assert (frame.arbitration_id, frame.stamp_ns) == (0x80, 5 * MS * frame.seq)


def test_error_frames_come_before_the_frames_and_lead_to_passive():
    rig, got = frames_of(strike("can_error_frames", "analog", duration_s=10.0), ticks=300)
    errors = [frame for frame in got if frame.flags & FLAG_ERROR]
    assert [frame.seq for frame in got if not frame.flags] == list(range(1, 301))
    assert len(errors) == 291 + len(rig.noted)
    states = [frame.data[1] for frame in rig.noted if frame.arbitration_id & ERROR_CONTROLLER]
    assert states == [0x04, 0x10]  # receive warning, receive passive


def test_off_the_bus_nothing_comes_the_port_is_told_and_it_comes_back():
    rig, got = frames_of(strike("can_bus_off", "driver"))
    assert [frame.seq for frame in got] == [*range(1, 10), *range(20, 31)]
    classes = [frame.arbitration_id & (ERROR_BUS_OFF | ERROR_RESTARTED) for frame in rig.noted]
    assert classes == [ERROR_BUS_OFF] * 10 + [ERROR_RESTARTED]


def sent_through(strikes, off=(), ticks=30):
    rig, answers = Rig(), []
    sender = FaultySender(rig, list(strikes), list(off), rig.extra.append)
    for _ in range(ticks):
        rig.tick()
        answers.append(sender.send(0x100, bytes([rig.n]), rig.now))
    return rig, answers


def test_a_lost_valve_frame_is_one_that_did_not_get_out():
    rig, answers = sent_through([strike("can_drop", "command")])
    assert [data[0] for _, data, _ in rig.sent] == [*range(1, 10), *range(20, 31)]
    assert answers == [True] * 9 + [False] * 10 + [True] * 11


def test_frames_that_go_out_beside_others_are_counted_for_whoever_waits_for_them():
    for kind, more in (("can_duplicate", {}), ("can_reorder", {}), ("can_delay", {"size": 12.0})):
        rig, answers = sent_through([strike(kind, "command", **more)])
        assert len(rig.sent) == len(rig.extra) + sum(answers)
        assert len(rig.sent) == (40 if kind == "can_duplicate" else 30)


def test_a_node_off_the_bus_sends_nothing():
    rig, answers = sent_through([], off=[strike("can_bus_off", "driver")])
    assert len(rig.sent) == 20
    assert answers.count(False) == 10


def test_bytes_are_hit_one_by_one():
    rig = Rig()
    port = FaultyBytes(rig, rig.now_ns, [strike("serial_drop", "inclinometer", probability=0.25)])
    pieces = []
    for _ in range(30):
        rig.tick()
        pieces.append(port.read(0.05))
    lengths = [len(piece) for piece in pieces]
    assert lengths[:9] == [8] * 9
    assert lengths[19:] == [8] * 11
    assert 40 < sum(lengths[9:19]) < 75


def samples(channel, strikes, ticks=30, **fields):
    """The messages that leave a publisher into which one is put each tick, numbered."""
    type_, out, clock = message(channel.message), [], SimpleNamespace(now=0)
    put = spoiled_put(channel, lambda payload: out.append(type_.unpack(payload)), lambda: clock.now, list(strikes))
    for n in range(1, ticks + 1):
        clock.now = 5 * MS * n
        put(type_.pack(type_.make(seq=n, **{name: value + n for name, value in fields.items()})))
    return out


def test_a_stuck_value_stays_at_what_it_was_and_others_go_on():
    out = samples(PRESSURE, [strike("sensor_stuck", "chamber_pressure")], chamber_pressure_kpa=50.0, supply_pressure_kpa=300.0)
    assert [m.chamber_pressure_kpa for m in out] == [*range(51, 60), *[60] * 10, *range(70, 81)]
    assert [m.supply_pressure_kpa for m in out] == list(range(301, 331))


def test_bias_noise_and_no_number():
    biased = samples(INCLINATION, [strike("sensor_bias", "angle", size=-4.0)], angle_deg=0.0)
    assert [m.angle_deg - m.seq for m in biased] == [0.0] * 9 + [-4.0] * 10 + [0.0] * 11
    noisy = samples(INCLINATION, [strike("sensor_noise", "rate", size=2.0)], rate_deg_s=0.0)
    off = [m.rate_deg_s - m.seq for m in noisy]
    assert set(off[:9] + off[19:]) == {0.0}
    assert 0.5 < math.sqrt(sum(value**2 for value in off[9:19]) / 10) < 4.0
    nothing = samples(PRESSURE, [strike("sensor_nan", "chamber_pressure")], chamber_pressure_kpa=1.0)
    assert [math.isnan(m.chamber_pressure_kpa) for m in nothing] == [False] * 9 + [True] * 10 + [False] * 11


@pytest.mark.parametrize(("kind", "more", "seqs"), [
    ("zenoh_drop", {}, [*range(1, 10), *range(20, 31)]),
    ("zenoh_delay", {"size": 10.0}, [*range(1, 10), *range(10, 19), 20, 19, *range(21, 31)]),
    ("zenoh_reorder", {}, [*range(1, 10), 11, 10, 13, 12, 15, 14, 17, 16, 19, 18, *range(20, 31)]),
    ("zenoh_duplicate", {}, [*range(1, 10), *[n for n in range(10, 20) for _ in range(2)], *range(20, 31)]),
])  # fmt: skip
def test_samples_are_lost_late_swapped_and_doubled(kind, more, seqs):
    assert [m.seq for m in samples(PRESSURE, [strike(kind, "pressure", **more)])] == seqs


def test_a_spoiled_sample_is_still_of_its_size():
    out = samples(PRESSURE, [strike("zenoh_corrupt", "pressure", size=3.0)], chamber_pressure_kpa=1.0)
    sound = samples(PRESSURE, [], chamber_pressure_kpa=1.0)
    assert [SAMPLE.pack(a) != SAMPLE.pack(b) for a, b in zip(out, sound, strict=True)] == [False] * 9 + [True] * 10 + [False] * 11


class Machine:
    """A clock that goes on while it is slept on."""

    def __init__(self):
        self.now = 0

    def now_ns(self):
        return self.now

    def sleep_until_ns(self, deadline_ns):
        self.now = max(self.now, deadline_ns)


@pytest.mark.parametrize("size", [30.0, -30.0])
def test_a_clock_jumps_sleeps_as_long_as_before_and_jumps_back(size):
    machine = Machine()
    clock = SteppedClock(machine, [strike("clock_step", "controller", size=size)])
    ahead = []
    for _ in range(30):
        clock.sleep_until_ns(clock.now_ns() + 5 * MS)
        ahead.append(clock.now_ns() - machine.now)
    assert machine.now == 150 * MS
    assert ahead == [0] * 9 + [round(size * MS)] * 10 + [0] * 11
