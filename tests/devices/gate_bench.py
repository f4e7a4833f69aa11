"""The gate's step function with records and a clock around it, for tests."""

from softloop.devices import gate as g
from softloop.devices.config import PERIOD_NS, InclinometerConfig, PressuresConfig, ValvesConfig, valves_process
from softloop.wire.can_config import CanConfig
from softloop.wire.kernel import new_record

START_NS = 1_000_000_000
PRESSURE_DELAY_NS, INCLINATION_DELAY_NS = 2_000_000, 4_000_000  # from stamp to gate when all is well


def process(**valves):
    return valves_process(ValvesConfig(**valves), PressuresConfig(), InclinometerConfig(port="x"), {"can0": CanConfig()})


class GateBench:
    """A gate with a living driver; each `tick` is one period and one step, with a good command unless told otherwise."""

    def __init__(self, **valves):
        self.process = process(**{"vent_settle_s": 0.0, **valves})
        self.config = g.gate_config(self.process)
        self.state, self.given, self.output = (new_record(d) for d in (g.GATE_STATE, g.GATE_INPUT, g.GATE_OUTPUT))
        self.now_ns = START_NS
        self.seq, self.arms = 1000, 0
        self.asked = {}

    def tick(self, *, command=True, heard=True, after_ns=PERIOD_NS, **fields):
        """One step; `fields` replace what the inputs would be. Returns the output record."""
        self.now_ns += after_ns
        given = self.given
        given.now_ns, given.command_new = self.now_ns, int(command)
        given.stop = given.disarm = given.arm = given.bus_off = given.shutdown = 0
        if command:
            self.seq += 1
            given.command_received_ns, given.command_seq, given.ready = self.now_ns, self.seq, 1
            given.pressure_stamp_ns = self.now_ns - PRESSURE_DELAY_NS
            given.inclination_stamp_ns = self.now_ns - INCLINATION_DELAY_NS
            given.chamber_pressure_kpa, given.angle_deg = 50.0, 70.0
            given.charge_current_ma, given.exhaust_current_ma = 100.0, 50.0
        if heard:
            given.driver, given.driver_stamp_ns = g.DRIVER_OK, self.now_ns
        for name, value in fields.items():
            given[name] = value
        g.gate_step(self.config, self.state, given, self.output)
        return self.output

    def arm(self, **fields):
        """A tick with an arm request not made before."""
        self.arms += 1
        return self.request(77, self.arms, **fields)

    def request(self, origin, seq, **fields):
        """A tick with an arm request, which answers what the gate said a tick before unless told otherwise."""
        self.asked = {"arm": 1, "arm_origin": origin, "arm_seq": seq, "arm_stamp_ns": self.now_ns}
        return self.tick(**(self.asked | fields))

    def armed(self):
        """Ticks until currents pass; returns this bench."""
        self.tick()
        assert self.arm().gate == g.GATE_ARMED
        return self


def word(output):
    """(gate, output, reason) of an output record."""
    return int(output.gate), int(output.output), int(output.reason)
