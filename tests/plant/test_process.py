"""The process on its wires: a gate and an inclinometer's host of the test's own, in real time for a second or two."""

import threading
import time
from contextlib import contextmanager

import pytest

from softloop.devices.protocols.can_frames import (
    ANALOG_INPUTS_ID,
    STATE_OK,
    STATE_WATCHDOG,
    VALVE_COMMAND_ID,
    VALVE_STATUS_ID,
    E2eReceiver,
    ValveCommandFrame,
    decode_analog_inputs,
    decode_valve_status,
    encode_valve_command,
    next_counter,
)
from softloop.devices.protocols.quantise import counts_to_deg
from softloop.devices.protocols.wt931 import ANGLE, READ, REGISTERS, RRATE, Parser, encode_command
from softloop.plant.config import PlantConfig, plant_process
from softloop.plant.process import run
from softloop.plant.wires import Outbox
from softloop.wire.can_config import CanConfig, open_port
from softloop.wire.channels import EVENT, STATUS, TRUTH
from softloop.wire.clock import WallClock
from softloop.wire.messages import constant, message
from softloop.wire.pace import Pace
from softloop.wire.serial_urls import open_serial
from softloop.wire.session import open_wire
from softloop.wire.shell import Context
from tests.wire.rendezvous import meeting, short_folder

BUSES = {"can0": CanConfig(), "can1": CanConfig(channel="can1")}


class Bench:
    """The other side of all of the plant's wires."""

    def __init__(self, wire, context, can):
        self.wire, self.context, self.can = wire, context, can
        self.truths, self.events, self.statuses = wire.inbox(TRUTH), wire.inbox(EVENT), wire.inbox(STATUS)
        self.counter = self.seq = 0

    def command(self, charge_ma, spoil=0):
        self.counter, self.seq = next_counter(self.counter), self.seq + 1
        data = bytearray(encode_valve_command(ValveCommandFrame(self.counter, 1, round(100 * charge_ma), 0, self.seq)))
        data[3] ^= spoil
        self.can.send(VALVE_COMMAND_ID, bytes(data), self.context.clock.now_ns())

    def hold(self, charge_ma, seconds, spoil=0):
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.command(charge_ma, spoil)
            time.sleep(0.005)

    def frames(self, arbitration_id):
        found = []
        while (frame := self.can.recv(0.0)) is not None:
            if frame.arbitration_id == arbitration_id:
                found.append(frame)
        return found

    def taken(self, inbox, name):
        return [message(name).unpack(payload) for _, payload in inbox.take_all()]


def wait_for(what, timeout_s=5.0):
    until = time.monotonic() + timeout_s
    while time.monotonic() < until:
        if what():
            return True
        time.sleep(0.01)
    return False


class StallingClock(WallClock):
    """Oversleeps once, by 50 ms, when asked to."""

    def __init__(self):
        self.stall = False

    def sleep_until_ns(self, deadline_ns):
        stalled, self.stall = self.stall, False
        super().sleep_until_ns(deadline_ns + (50_000_000 if stalled else 0))


@contextmanager
def running(clock=None, **plant):
    with (
        meeting() as zenoh,
        short_folder() as folder,
        open_wire(zenoh, "test", "plant") as wire,
        open_wire(zenoh, "test", "other") as other,
    ):
        context = Context("plant", "test", folder, wire, Pace(clock))
        context.enter_loop = wire.declare_alive  # the test's process keeps its garbage collector
        config = plant_process(PlantConfig.model_validate(plant), BUSES)
        can = open_port(BUSES["can0"], "can0", other, context.clock, (VALVE_STATUS_ID, ANALOG_INPUTS_ID))
        bench = Bench(other, context, can)
        faults = []

        def body():
            try:
                run(config, context)
            except Exception as fault:  # noqa: BLE001 - the test's own thread reports
                faults.append(fault)

        thread = threading.Thread(target=body, daemon=True)
        thread.start()
        try:
            assert wait_for(lambda: "plant" in other.processes_alive(0.1) or faults)
            yield bench
        finally:
            context.stop.set("test")
            thread.join(10.0)
            can.close()
        assert not thread.is_alive()
        assert faults == []


def test_frames_bytes_truth_and_watchdog():
    with running(seed=1, layer="ideal", watchdog_ms=300.0) as bench:
        port = open_serial(str(bench.context.run_dir / "inclinometer"), 115_200, 0.0)
        bench.frames(0)
        bench.hold(100.0, 0.6)
        status = bench.frames(VALVE_STATUS_ID)
        assert len(status) > 20
        judge = E2eReceiver(VALVE_STATUS_ID, 4)
        assert all(judge.judge(f.data).usable for f in status)
        last = decode_valve_status(status[-1].data)
        assert last.state == STATE_OK
        assert last.charge_counts == pytest.approx(10_000, abs=40)
        packets = Parser().feed(port.read(100_000))
        angles = [counts_to_deg(p.words[0]) for p in packets if p.kind == ANGLE]
        assert angles[0] == pytest.approx(26.7, abs=0.4)
        assert angles[-1] > 27.5
        time.sleep(0.6)
        assert decode_valve_status(bench.frames(VALVE_STATUS_ID)[-1].data).state == STATE_WATCHDOG
        port.close()
        truths = bench.taken(bench.truths, "PlantTruth")
        assert truths[-1].stamp_ns - truths[0].stamp_ns == 5_000_000 * (truths[-1].seq - truths[0].seq)
        assert max(t.chamber_pressure_kpa for t in truths) > 10.0
        assert truths[-1].exhaust_coil_ma == 200.0
        kinds = [(e.kind, e.code) for e in bench.taken(bench.events, "Event")]
        driver = constant("Event", "KIND_DRIVER")
        assert kinds[0] == (driver, constant("ValveStatus", "DRIVER_OK"))
        assert kinds[-1] == (driver, constant("ValveStatus", "DRIVER_WATCHDOG"))


def test_spoiled_frames_do_not_reach_the_driver():
    with running(seed=1) as bench:
        bench.hold(100.0, 0.2, spoil=1)
        truths = bench.taken(bench.truths, "PlantTruth")
        assert {t.command_counter for t in truths} == {0}
        assert {t.driver for t in truths} == {constant("ValveStatus", "DRIVER_WATCHDOG")}


def test_two_buses_and_a_load_and_nobody_at_the_serial_port():
    loads = [{"kind": "payload", "on_s": 0.2, "off_s": 0.4, "size": 300.0}]
    with running(seed=1, can_analog="can1", serial="listen://127.0.0.1:0", loads=loads) as bench:
        other = open_port(BUSES["can1"], "can1", bench.wire, bench.context.clock, (ANALOG_INPUTS_ID,))
        time.sleep(0.7)
        analog = []
        while (frame := other.recv(0.0)) is not None:
            analog.append(decode_analog_inputs(frame.data))
        assert len(analog) > 20
        counters = [a.counter for a in analog]
        assert counters == [(counters[0] + n) % 256 for n in range(len(counters))]
        assert bench.frames(ANALOG_INPUTS_ID) == []
        events = bench.taken(bench.events, "Event")
        assert [(e.kind, e.code, e.reason, e.value) for e in events] == [
            (constant("Event", "KIND_LOAD"), 1, 1, 300.0),
            (constant("Event", "KIND_LOAD"), 0, 1, 300.0),
        ]
        assert events[1].stamp_ns - events[0].stamp_ns == 200_000_000
        other.close()


def test_the_inclinometer_answers_its_host():
    with running(seed=1) as bench:
        port = open_serial(str(bench.context.run_dir / "inclinometer"), 115_200, 0.0)
        port.write(encode_command(READ, RRATE))
        parser, found = Parser(), []
        assert wait_for(lambda: found.extend(p for p in parser.feed(port.read(4096)) if p.kind == REGISTERS) or found)
        assert found[0].words[0] == 0x0B
        port.close()


def test_status_says_what_it_is():
    with running(seed=1) as bench:
        statuses = []
        assert wait_for(lambda: statuses.extend(bench.taken(bench.statuses, "ProcessStatus")) or len(statuses) >= 1)
    assert statuses[0].process == constant("Event", "SOURCE_PLANT")


def test_a_stall_is_counted_and_frames_sent_meanwhile_take_effect_at_their_time():
    clock = StallingClock()
    with running(clock, seed=1, watchdog_ms=200.0) as bench:
        bench.hold(80.0, 0.2)
        misses = bench.taken(bench.truths, "PlantTruth")[-1].deadline_misses
        clock.stall = True
        bench.hold(80.0, 0.3)
        truths = bench.taken(bench.truths, "PlantTruth")
    assert truths[-1].deadline_misses > misses
    assert max(truth.late_max_ns for truth in truths) > 40_000_000
    assert [t.seq for t in truths] == list(range(truths[0].seq, truths[-1].seq + 1))
    # Every valve frame was applied in order; most exactly at their end, though the plant looked 50 ms later.
    exact = [t.command_applied_ns == t.command_end_ns for t in truths]
    assert sum(exact) > 0.5 * len(exact)


def test_the_outbox_gives_in_the_order_of_arrival():
    outbox = Outbox()
    for end_ns, kind in ((30, 1), (10, 2), (20, 3), (10, 4)):
        outbox.add(end_ns, kind, None)
    assert outbox.next_ns == 10
    assert [(end, kind) for end, kind, _ in outbox.take(20)] == [(10, 2), (10, 4), (20, 3)]
    assert outbox.next_ns == 30
