"""The gate with a CANopen node as valve driver: canopen's local node at the other end of the bus `zenoh`."""

import time
from contextlib import contextmanager
from dataclasses import replace

import can
import pytest

from softloop.devices import canopen_node, valves
from softloop.devices import gate as g
from softloop.devices.canopen_node import talking
from softloop.devices.protocols.canopen_output import required_settings
from softloop.devices.valve_driver import make_driver
from softloop.wire.can_config import CanConfig, open_port
from softloop.wire.clock import WallClock
from softloop.wire.errors import Unavailable
from softloop.wire.messages import constant
from tests.devices.adapters import bench, run_to_its_end, running
from tests.devices.canopen_module import OPERATIONAL, STOPPED, Module
from tests.devices.gate_bench import process
from tests.devices.test_valves import Rig

KIND_GATE = constant("Event", "KIND_GATE")
CLOCK = WallClock()
STOP = constant("GateRequest", "ACTION_STOP")
WIDE = {"hold_ticks": 20, "age_ticks": 20, "path_delay_ms": 500, "driver_silence_ms": 500}
# Wide deadlines for a busy machine, and a module whose outputs are not in the order charge, exhaust.
ANALOG = {"node_id": 5, "charge_output": 3, "exhaust_output": 2, "deadline_ms": 200, "gate_heartbeat_ms": 1000}
CURRENT = {"node_id": 9, "deadline_ms": 200, "gate_heartbeat_ms": 1000}


def config(kind="canopen_analog", **node):
    given = {"canopen_analog": ANALOG, "canopen_current": CURRENT}[kind] | node
    made = process(driver=kind, **{kind: given}, **WIDE)
    # Two seconds, more than a bench may have: the controller is a thread of a busy test, and its silence is not what is tried.
    return replace(made, valves=made.valves.model_copy(update={"hold_ticks": 400}))


def plan_of(config):
    return config.valves.node.plan(config.valves.vent_current_ma)


class CanopenRig(Rig):
    """Controller and person around the gate, and the module on the bus."""

    def __init__(self, wire, config, **how):
        super().__init__(wire)
        self.driver = False  # the rig's own one
        self.plan = plan_of(config)
        bus = can.Bus(interface="zenoh", channel="can0", session=wire.session, bench="test", ignore_config=True)
        self.module = Module(
            bus, self.plan.node_id, outputs=tuple(sorted(self.plan.outputs)), measured=self.plan.measured_index, **how
        )

    def configure(self):
        port = open_port(CanConfig(), "can0", self.wire_of_tool, CLOCK, make_driver(self.config).receive)
        try:
            with talking(port, self.plan.node_id, CLOCK) as talk:
                settings = required_settings(self.plan)
                before = talk.wrong(settings)
                talk.write(settings)
                talk.store()
                return before, talk.wrong(settings)
        finally:
            port.close()

    def drain(self):
        while self.port.recv(0.0) is not None:
            pass

    def silent_for(self, seconds):
        """Let the module look at a time so long after the last receive PDO, however long that was on this machine."""
        module, looked = self.module, self.module.looks
        module.clock = lambda: module.pdo_at + seconds
        self.until(lambda: module.looks > looked + 1)

    @property
    def currents(self):
        """(charge, exhaust) in mA, as the module gives them."""
        counts = self.module.counts
        return tuple(round(self.plan.scale.current_ma(counts[sub]), 1) for sub in self.plan.outputs)


@contextmanager
def canopen_rig(meet, config, **how):
    with bench(meet) as (a, b), pytest.MonkeyPatch.context() as patch:
        # On a busy machine an answer may take longer; asked again, the node answers twice, and the next question gets the second.
        patch.setattr(canopen_node, "_ANSWER_S", 10.0)
        rig = CanopenRig(b, config, **how)
        rig.wire_of_tool, rig.config, rig.wire_of_gate = a, config, a
        try:
            yield rig
        finally:
            rig.module.close()
            rig.port.close()


@pytest.mark.parametrize("kind", ["canopen_analog", "canopen_current"])
def test_a_gate_that_dies_is_vented_by_the_module_itself(meet, tmp_path, kind):
    given = config(kind)
    with canopen_rig(meet, given) as rig:
        before, after = rig.configure()
        assert (len(before) > 8, after, rig.module.stored) == (True, [], 1)
        with running(valves.run, given, rig.wire_of_gate, tmp_path) as adapter:
            rig.arm()
            rig.until(lambda: rig.currents == (100.0, 20.0))
            assert rig.module.node.nmt.state == OPERATIONAL
            if rig.plan.measured_index:
                rig.until(lambda: (rig.newest("charge_coil_ma"), rig.newest("exhaust_coil_ma")) == (100.0, 20.0))
            rig.module.listen, kept = lambda message: None, rig.module.listen
            rig.module.network.notifier.listeners[:] = []  # the cable to the module is cut
            rig.silent_for(0.199)
            assert not rig.module.in_error
            rig.silent_for(0.201)
            rig.until(lambda: rig.module.in_error)
            assert rig.currents == (0.0, 200.0)
            rig.module.clock = time.monotonic
            rig.until(lambda: rig.events.find(kind=KIND_GATE, code=g.GATE_FAULT, reason=g.REASON_DRIVER_SILENT))
            assert rig.module.node.nmt.state == STOPPED
            rig.module.network.notifier.listeners[:] = [kept]  # and whole again: no re-arming by itself
            rig.until(lambda: rig.module.node.nmt.state == OPERATIONAL)
            assert rig.newest("gate") == g.GATE_FAULT
            rig.until(lambda: rig.currents[0] == 0.0 and rig.currents[1] in (0.0, 200.0))
            del adapter


def test_a_silent_heartbeat_alone_vents_too(meet, tmp_path):
    """The receive PDOs go on, as from a gate whose timer alone has died: the second deadline is one of its own."""
    given = config(deadline_ms=400, gate_heartbeat_ms=150)
    with canopen_rig(meet, given) as rig:
        rig.configure()
        with running(valves.run, given, rig.wire_of_gate, tmp_path):
            rig.arm()
            rig.until(lambda: rig.currents == (100.0, 20.0))
            rig.until(lambda: rig.module.heartbeat_at)  # a consumer watches from the first one on
            rig.module.network.subscribers.clear()
            deaf = rig.plan.gate_heartbeat_id
            rig.module.listen, heard = (lambda m: m.arbitration_id != deaf and heard(m)), rig.module.listen
            rig.module.network.notifier.listeners[:] = [rig.module.listen]
            rig.until(lambda: rig.module.vented_at)  # the gate, which sees it, may start the node again at once


def test_a_node_that_would_not_vent_by_itself_is_not_used(meet, tmp_path):
    given = config()
    with canopen_rig(meet, given) as rig, pytest.raises(Unavailable) as refused:
        run_to_its_end(valves.run, given, rig.wire_of_gate, tmp_path)
    said = str(refused.value)
    assert said.startswith("CANopen node 5 on CAN bus 'can0': 1016h:01 (heartbeat consumer: the gate): holds 0, must hold 8258")
    assert said.endswith("; run `softloop canopen configure BENCH.toml`")
    assert "\n" not in said


@pytest.mark.parametrize(
    ("lacks", "name"), [(0x1016, "1016h:01"), (0x1029, "1029h:01"), (0x6443, "6443h:03"), (0x6444, "6444h:03")]
)
def test_a_node_without_an_object_that_makes_it_safe_is_refused(meet, tmp_path, lacks, name):
    given = config()
    with canopen_rig(meet, given, without=(lacks,)) as rig:
        with pytest.raises(Unavailable, match=f"refuses {name} .*Object does not exist; it cannot vent by itself"):
            rig.configure()
        with pytest.raises(Unavailable, match=r"run `softloop canopen configure"):
            run_to_its_end(valves.run, given, rig.wire_of_gate, tmp_path)


def test_a_node_that_is_not_there_is_one_line(meet, tmp_path):
    with bench(meet) as (a, _), pytest.raises(Unavailable, match=r"^CANopen node 5 on CAN bus 'can0' does not answer; [^\n]+$"):
        run_to_its_end(valves.run, config(), a, tmp_path)


def test_a_node_that_restarts_is_not_commanded_again(meet, tmp_path):
    """It may have forgotten which output is which."""
    given = config()
    with canopen_rig(meet, given) as rig:
        rig.configure()
        with running(valves.run, given, rig.wire_of_gate, tmp_path):
            rig.arm()
            rig.until(lambda: rig.currents == (100.0, 20.0))
            rig.module.power_cycle()
            rig.until(lambda: rig.events.find(kind=KIND_GATE, code=g.GATE_FAULT, reason=g.REASON_DRIVER_SILENT))
            seen = rig.newest("seq")
            rig.until(lambda: rig.newest("seq") > seen + 210)
            assert (rig.currents, rig.module.node.nmt.state != OPERATIONAL) == ((0.0, 0.0), True)


def test_an_emergency_message_is_a_fault(meet, tmp_path):
    given = config()
    with canopen_rig(meet, given) as rig:
        rig.configure()
        with running(valves.run, given, rig.wire_of_gate, tmp_path):
            rig.arm()
            rig.module.node.emcy.send(0x2310, 0x02)  # over-current
            rig.until(lambda: rig.events.find(kind=KIND_GATE, code=g.GATE_FAULT, reason=g.REASON_DRIVER_SILENT))


def test_a_stop_vents_and_what_is_sent_is_what_the_module_can_give(meet, tmp_path):
    given = config(low_ma=40.0, low_counts=3000)
    with canopen_rig(meet, given) as rig:
        rig.configure()
        with running(valves.run, given, rig.wire_of_gate, tmp_path):
            rig.arm()
            rig.until(lambda: rig.currents == (100.0, 0.0))  # 20 mA is below the stage's least
            rig.until(lambda: rig.newest("exhaust_current_ma") == 0.0 and 99.98 < rig.newest("charge_current_ma") <= 100.0)
            assert rig.newest("charge_coil_ma") != rig.newest("charge_coil_ma")  # NaN: not measured
            rig.request(STOP)
            rig.until(lambda: rig.currents == (0.0, 200.0))
