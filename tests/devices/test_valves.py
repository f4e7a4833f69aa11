"""The gate's process on a real Zenoh bench, with a valve driver of ours on the CAN bus `zenoh`."""

import time
from dataclasses import replace

import pytest

from softloop.devices import gate as g
from softloop.devices import valves
from softloop.devices.protocols import can_frames as cf
from softloop.wire.can_config import CanConfig, open_port
from softloop.wire.can_frame import ERROR_BUS_OFF, FLAG_ERROR
from softloop.wire.channels import ARM as ARM_CHANNEL
from softloop.wire.channels import COMMAND, REQUEST, VALVES
from softloop.wire.clock import WallClock
from softloop.wire.errors import Unavailable
from softloop.wire.messages import constant, message
from tests.devices.adapters import bench, listeners, run_to_its_end, running, until
from tests.devices.gate_bench import process

ARM, STOP = constant("GateRequest", "ACTION_ARM"), constant("GateRequest", "ACTION_STOP")
KIND_GATE, KIND_BUS = constant("Event", "KIND_GATE"), constant("Event", "KIND_BUS")
CLOCK = WallClock()
# Budgets wide enough for a busy test machine; what they are is tested on the pure function.
CONFIG = process(hold_ticks=20, age_ticks=20, path_delay_ms=500, driver_silence_ms=500)


class Rig:
    """Controller, person and valve driver around the gate."""

    def __init__(self, wire):
        self.port = open_port(CanConfig(), "can0", wire, CLOCK, [cf.VALVE_COMMAND_ID])
        self.judge = cf.E2eReceiver(cf.VALVE_COMMAND_ID, 1)
        self.frames, self.verdicts = [], []
        self.put_command = wire.publisher(COMMAND)
        self.put_request, self.put_arm = wire.publisher(REQUEST), wire.publisher(ARM_CHANNEL)
        self.valves, self.events, self.status = listeners(wire, VALVES)
        self.seq = self.requests = self.counter = 0
        self.driver = True

    def turn(self, **fields):
        """One tick of controller and driver."""
        if self.driver:
            self.counter = cf.next_counter(self.counter)
            self.port.send(
                cf.VALVE_STATUS_ID, cf.encode_valve_status(cf.ValveStatusFrame(self.counter, 0, 111, 222, 3)), CLOCK.now_ns()
            )
        self.seq += 1
        now_ns = CLOCK.now_ns()
        command = message("ValveCommand")
        values = {
            "seq": self.seq, "stamp_ns": now_ns, "tick": self.seq,
            "pressure_stamp_ns": now_ns - 1, "inclination_stamp_ns": now_ns - 1,
            "chamber_pressure_kpa": 50.0, "angle_deg": 60.0, "charge_current_ma": 100.0, "exhaust_current_ma": 20.0, "ready": 1,
        }  # fmt: skip
        self.put_command(command.pack(command.make(**(values | fields))))
        time.sleep(0.005)
        self.drain()

    def drain(self):
        while (frame := self.port.recv(0.0)) is not None:
            self.verdicts.append(self.judge.judge(frame.data))
            self.frames.append(cf.decode_valve_command(frame.data))

    def request(self, action, put=None, age_ns=0):
        self.requests += 1
        request = message("GateRequest")
        put = put or (self.put_arm if action == ARM else self.put_request)
        put(request.pack(request.make(seq=self.requests, stamp_ns=CLOCK.now_ns() - age_ns, origin=2**63 + 5, action=action)))

    def until(self, condition, **fields):
        return until(lambda: self.turn(**fields) or condition())

    def newest(self, field):
        seen = self.valves.look()
        return getattr(seen[-1], field) if seen else None

    def arm(self):
        self.until(lambda: self.newest("driver") == g.DRIVER_OK and self.newest("command_seq"))
        self.request(ARM)
        self.until(lambda: self.newest("gate") == g.GATE_ARMED)


@pytest.fixture
def rig(meet, tmp_path):
    with bench(meet) as (a, b):
        rig = Rig(b)
        with running(valves.run, CONFIG, a, tmp_path) as adapter:
            rig.adapter = adapter
            yield rig
        rig.drain()
        rig.port.close()


def test_it_arms_passes_currents_and_faults_on_stop(rig):
    rig.arm()
    rig.until(lambda: rig.frames[-1].output == g.OUTPUT_PASS)
    assert rig.frames[-1][2:4] == (10_000, 2_000)
    armed = rig.events.find(kind=KIND_GATE, code=g.GATE_ARMED)
    assert armed.tick > 0
    rig.request(STOP)
    rig.until(lambda: rig.frames[-1].output == g.OUTPUT_VENT)
    assert rig.frames[-1][2:4] == (0, 20_000)
    rig.until(lambda: rig.events.find(kind=KIND_GATE, code=g.GATE_FAULT, reason=g.REASON_EMERGENCY_STOP))


def test_the_monitors_request_is_a_fault_of_its_own_reason(rig):
    rig.arm()
    rig.until(lambda: rig.frames[-1].output == g.OUTPUT_PASS)
    rig.request(constant("GateRequest", "ACTION_FAULT"))
    rig.until(lambda: rig.frames[-1].output == g.OUTPUT_VENT)
    rig.until(lambda: rig.events.find(kind=KIND_GATE, code=g.GATE_FAULT, reason=g.REASON_INVARIANT))


def test_each_frame_has_its_status_and_the_counters_go_on(rig):
    rig.arm()
    for _ in range(100):
        rig.turn()
    statuses = rig.valves.look()
    assert [s.seq for s in statuses] == list(range(statuses[0].seq, statuses[0].seq + len(statuses)))
    assert all(v == cf.Verdict.OK for v in rig.verdicts)
    by_seq = {s.seq & 0xFFFF: s for s in statuses}
    for frame in rig.frames:
        assert (by_seq[frame.seq].output, round(by_seq[frame.seq].charge_current_ma * 100)) == (frame.output, frame.charge_counts)
    answered = [s.command_seq for s in statuses if s.command_seq]
    assert answered == sorted(set(answered)), "one frame for each command"
    newest = statuses[-1]
    assert (newest.charge_coil_ma, newest.exhaust_coil_ma) == (1.11, 2.22)
    assert newest.command_received_ns <= newest.stamp_ns


def test_a_silent_controller_is_a_fault_and_frames_go_on(rig):
    rig.arm()
    until(lambda: rig.drain() or rig.events.find(kind=KIND_GATE, code=g.GATE_FAULT))
    seen = len(rig.frames)
    until(lambda: rig.drain() or len(rig.frames) > seen + 10)
    assert rig.newest("gate") == g.GATE_FAULT
    assert {f.output for f in rig.frames[-5:]} == {g.OUTPUT_VENT}
    assert rig.newest("command_seq") == 0


def test_a_bus_without_a_driver_never_arms_and_says_so(rig, capfd):
    rig.driver = False
    rig.until(lambda: rig.newest("command_seq"))
    rig.request(ARM)
    refused = rig.until(lambda: rig.events.find(kind=KIND_GATE, code=g.GATE_DISARMED, reason=g.REASON_DRIVER_SILENT))
    assert refused
    text = ""

    def said():
        nonlocal text
        text += capfd.readouterr().err
        return "nothing is heard from the valve driver on CAN bus 'can0'; the gate will not arm" in text

    rig.until(said)
    assert rig.newest("driver") == g.DRIVER_SILENT
    assert {f.output for f in rig.frames} <= {g.OUTPUT_VENT, g.OUTPUT_CLOSED}


def test_broken_driver_frames_are_counted_and_do_not_help(rig):
    rig.driver = False

    def send_broken():
        rig.port.send(cf.VALVE_STATUS_ID, b"\x00" * 8, CLOCK.now_ns())
        rig.port.send(cf.VALVE_STATUS_ID, b"\x00" * 3, CLOCK.now_ns())
        return rig.newest("rejected")

    assert rig.until(send_broken) > 0
    assert rig.newest("driver") == g.DRIVER_SILENT


def test_bus_off_is_a_fault(rig):
    rig.arm()
    rig.port.bus.send_frame(ERROR_BUS_OFF, bytes(8), CLOCK.now_ns(), FLAG_ERROR)
    until(lambda: rig.events.find(kind=KIND_GATE, code=g.GATE_FAULT, reason=g.REASON_BUS_OFF))
    until(lambda: rig.events.find(kind=KIND_BUS, code=1))
    rig.until(lambda: rig.events.find(kind=KIND_BUS, code=0))
    assert rig.newest("gate") == g.GATE_FAULT


def test_payloads_that_are_no_command_or_request_change_nothing(rig):
    rig.arm()
    rig.put_command(b"nonsense")
    rig.put_request(b"")
    before = rig.seq
    rig.until(lambda: rig.newest("command_seq") > before)
    assert rig.newest("gate") == g.GATE_ARMED
    rig.until(lambda: any(s.dropped >= 2 for s in rig.status.look()))


def test_it_vents_before_it_ends(rig):
    rig.arm()
    rig.until(lambda: rig.frames[-1].output == g.OUTPUT_PASS)
    rig.adapter.stop()
    rig.drain()
    assert [f.output for f in rig.frames[-5:]] == [g.OUTPUT_VENT] * 5
    until(lambda: rig.newest("reason") == g.REASON_SHUTDOWN)


def test_a_bus_that_is_not_there_is_one_line(meet, tmp_path):
    config = replace(CONFIG, bus=CanConfig(interface="socketcan", channel="nosuchcan"))
    with bench(meet) as (a, _), pytest.raises(Unavailable, match=r"^CAN bus socketcan:nosuchcan: [^\n]+$"):
        run_to_its_end(valves.run, config, a, tmp_path)


def test_a_request_that_was_held_back_does_not_arm(rig):
    rig.until(lambda: rig.newest("driver") == g.DRIVER_OK and rig.newest("command_seq"))
    rig.request(ARM, age_ns=2 * g.ARM_AGE_NS)
    rig.until(lambda: rig.events.find(kind=KIND_GATE, reason=g.REASON_OLD_REQUEST))
    assert rig.newest("gate") == g.GATE_DISARMED
    rig.arm()


def test_of_two_requests_at_once_both_are_used_up(rig):
    rig.until(lambda: rig.newest("driver") == g.DRIVER_OK and rig.newest("command_seq"))
    kind = message("GateRequest")
    asked = [kind.make(seq=1, stamp_ns=CLOCK.now_ns(), origin=origin, action=ARM) for origin in (1, 2)]
    for one in asked:
        rig.put_arm(kind.pack(one))
    rig.until(lambda: rig.newest("gate") == g.GATE_ARMED)
    rig.request(STOP)
    rig.until(lambda: rig.newest("gate") == g.GATE_FAULT)
    for one in asked:  # played again, as if asked now
        rig.put_arm(kind.pack(one._replace(stamp_ns=CLOCK.now_ns())))
    for _ in range(20):
        rig.turn()
    assert rig.newest("gate") == g.GATE_FAULT


def test_a_request_under_a_key_that_is_not_its_own_is_thrown_away(rig):
    rig.until(lambda: rig.newest("gate") == g.GATE_DISARMED)
    rig.request(ARM, rig.put_request)
    rig.until(lambda: any(status.dropped for status in rig.status.look()))
    assert rig.newest("gate") == g.GATE_DISARMED
    rig.arm()
    for action in (STOP, constant("GateRequest", "ACTION_DISARM"), constant("GateRequest", "ACTION_FAULT")):
        rig.request(action, rig.put_arm)
    for _ in range(20):
        rig.turn()
    assert rig.newest("gate") == g.GATE_ARMED
