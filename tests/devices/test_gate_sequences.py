"""The gate over random sequences of events: without a new arm request nothing leads from FAULT to current in the charge valve."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from softloop.devices import gate as g
from softloop.devices.config import PERIOD_NS
from tests.devices.gate_bench import GateBench
from tests.devices.test_gate import FAULTS

MS = 1_000_000
CONDITIONS = [fault for fault in FAULTS if "stop" not in fault[1]]
ANYTHING = st.fixed_dictionaries(
    {},
    optional={
        "command": st.booleans(),
        "heard": st.booleans(),
        "after_ns": st.sampled_from([0, 1, MS, PERIOD_NS, 6_500_000, 30 * MS, 10_000 * MS]),
        "charge_current_ma": st.floats(allow_nan=True, allow_infinity=True),
        "exhaust_current_ma": st.floats(allow_nan=True, allow_infinity=True),
        "chamber_pressure_kpa": st.floats(allow_nan=True, allow_infinity=True),
        "angle_deg": st.floats(allow_nan=True, allow_infinity=True),
        "pressure_stamp_ns": st.integers(-(2**63), 2**63 - 1),
        "inclination_stamp_ns": st.integers(-(2**63), 2**63 - 1),
        "command_seq": st.integers(0, 2**63 - 1),
        "ready": st.integers(0, 1),
        "bus_off": st.integers(0, 1),
        "driver": st.sampled_from([g.DRIVER_OK, g.DRIVER_WATCHDOG, g.DRIVER_SILENT]),
        "stop": st.integers(0, 3),
        "disarm": st.integers(0, 1),
        "shutdown": st.integers(0, 1),
    },
)
OLD_REQUEST = st.sampled_from([{}, {"arm": 1, "arm_origin": 77, "arm_seq": 1}, {"arm": 1, "arm_origin": 77, "arm_seq": 0}])


@pytest.mark.parametrize("sensor", ["pressure", "inclination"])
def test_a_sample_of_this_very_moment_is_fresh_and_one_of_the_next_is_of_no_clock(sensor):
    bench = GateBench().armed()
    assert bench.tick(**{f"{sensor}_stamp_ns": bench.now_ns + PERIOD_NS}).gate == g.GATE_ARMED
    output = bench.tick(**{f"{sensor}_stamp_ns": bench.now_ns + PERIOD_NS + 1})
    assert (output.gate, output.reason) == (g.GATE_FAULT, g.REASON_SENSOR_STALE)


def is_vented_or_shut(output):
    return output.charge_counts == 0 and output.charge_current_ma == 0.0 and output.output != g.OUTPUT_PASS


@given(st.sampled_from(FAULTS), st.lists(st.tuples(ANYTHING, OLD_REQUEST), max_size=40))
@settings(max_examples=200, deadline=None)
def test_without_a_new_arm_request_no_sequence_leads_from_fault_to_charge_current(fault, events):
    bench = GateBench().armed()  # by request 1 of requester 77
    assert bench.tick(**fault[1]).gate == g.GATE_FAULT
    for step, request in events:
        output = bench.tick(**(step | request | {"arm_stamp_ns": bench.now_ns}))
        assert output.gate == g.GATE_FAULT
        assert is_vented_or_shut(output)


@given(st.lists(st.tuples(ANYTHING, st.booleans()), max_size=40))
@settings(max_examples=200, deadline=None)
def test_armed_only_by_a_new_request_on_a_good_step(events):
    bench = GateBench()
    for step, ask in events:
        before = int(bench.state.gate)
        output = bench.arm(**step) if ask else bench.tick(**step)
        if output.gate == g.GATE_ARMED:
            assert before == g.GATE_ARMED or ask
            assert 0.0 <= output.charge_current_ma <= 220.0
            assert 0.0 <= output.exhaust_current_ma <= 220.0
        else:
            assert is_vented_or_shut(output)


class GateMachine(RuleBasedStateMachine):
    """Events of a life of the gate in any order; the model beside it knows the table alone."""

    @initialize()
    def start(self):
        self.bench, self.armed, self.latched, self.silent = GateBench(), False, False, 0
        self.last = self.bench.tick()

    def step(self, ask=False, **fields):
        self.silent = 0 if fields.get("command", True) else self.silent + 1
        self.last = self.bench.arm(**fields) if ask else self.bench.tick(**fields)

    @rule()
    def good_command(self):
        self.step()

    @rule()
    def arm(self):
        self.step(ask=True)
        self.armed, self.latched = True, False

    @precondition(lambda self: self.bench.arms > 0)
    @rule()
    def old_arm_request(self):
        self.step(**self.bench.asked)

    @rule(origin=st.integers(0, 2**63 - 1), seq=st.integers(0, 2**63 - 1), late_ns=st.sampled_from([1, MS, 3600_000 * MS]))
    def held_back_arm_request(self, origin, seq, late_ns):
        """Of anybody, also of more than the gate remembers."""
        if origin != 77:  # whose numbers the model counts
            asked_ns = self.bench.now_ns + PERIOD_NS - g.ARM_AGE_NS - late_ns
            self.step(arm=1, arm_origin=origin, arm_seq=seq, arm_stamp_ns=asked_ns)

    @rule()
    def disarm(self):
        self.step(disarm=1)
        self.armed = False

    @rule(fault=st.sampled_from(CONDITIONS))
    def condition(self, fault):
        self.step(**fault[1])
        self.latched |= self.armed
        self.armed = False

    @rule(asked=st.integers(1, 3))
    def stop(self, asked):
        self.step(stop=asked)
        self.armed, self.latched = False, True

    @rule(fault=st.sampled_from(FAULTS))
    def arm_while_a_condition_holds(self, fault):
        self.step(ask=True, **fault[1])
        self.latched |= self.armed or "stop" in fault[1]
        self.armed = False

    @rule(ticks=st.integers(1, 10))
    def silence(self, ticks):
        for _ in range(ticks):
            self.step(command=False)
            if self.silent == 4:  # 3 ticks are held
                self.latched |= self.armed
                self.armed = False

    @rule()
    def back_from_silence(self):
        self.step()

    @invariant()
    def the_table_holds(self):
        wanted = g.GATE_ARMED if self.armed else g.GATE_FAULT if self.latched else g.GATE_DISARMED
        assert self.last.gate == wanted
        assert (self.last.charge_counts > 0) == self.armed


GateMachine.TestCase.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)
TestGateMachine = GateMachine.TestCase
