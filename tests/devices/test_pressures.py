"""The process `pressures` on a real Zenoh bench, with an analogue module of ours on the CAN bus `zenoh`."""

import subprocess
import sys
from dataclasses import replace

import pytest

from softloop.devices import pressures
from softloop.devices.config import PressuresConfig, SensorConfig, pressures_process
from softloop.devices.protocols.can_frames import ANALOG_INPUTS_ID, AnalogFrame, encode_analog_inputs
from softloop.devices.protocols.quantise import kpa_to_counts
from softloop.wire.can_config import CanConfig, open_port
from softloop.wire.channels import PRESSURE
from softloop.wire.clock import WallClock
from softloop.wire.errors import Unavailable
from softloop.wire.messages import constant
from tests.devices.adapters import bench, listeners, run_to_its_end, running, until

SUPPLY, CHAMBER = SensorConfig(zero_v=1.0, full_v=5.0, span_kpa=400.0), SensorConfig()
CONFIG = pressures_process(PressuresConfig(supply=SUPPLY, chamber=CHAMBER), {"can0": CanConfig()})
FRAME_NS = 270_000
CLOCK = WallClock()


class Module:
    def __init__(self, wire):
        self.port = open_port(CanConfig(), "can0", wire, CLOCK, [])
        self.samples, self.events, self.status = listeners(wire, PRESSURE)
        self.counter = 0

    def send(self, supply_kpa=200.0, chamber_kpa=50.0, stamp_ns=None, step=1):
        self.counter = (self.counter + step) % 256
        supply = kpa_to_counts(supply_kpa, SUPPLY.zero_v, SUPPLY.full_v, SUPPLY.span_kpa)
        chamber = kpa_to_counts(chamber_kpa, CHAMBER.zero_v, CHAMBER.full_v, CHAMBER.span_kpa)
        data = encode_analog_inputs(AnalogFrame(supply, chamber, self.counter))
        self.port.send(ANALOG_INPUTS_ID, data, stamp_ns or CLOCK.now_ns())

    def sample(self, **sent):
        """The sample that comes of one frame."""
        count = len(self.samples.look())
        self.send(**sent)
        return until(lambda: self.samples.look()[count:])[0]


@pytest.fixture
def module(meet, tmp_path):
    with bench(meet) as (a, b):
        module = Module(b)
        with running(pressures.run, CONFIG, a, tmp_path):
            until(lambda: module.send() or module.samples.look())  # until both ends are joined
            module.send(supply_kpa=123.0)
            # One way and one order (`meet`): with its sample all before it are here, and nothing else is under way.
            until(lambda: abs(module.samples.look()[-1].supply_pressure_kpa - 123.0) < 1.0)
            yield module
        module.port.close()


def test_a_frame_is_a_sample_in_kpa(module):
    sample = module.sample(supply_kpa=199.0, chamber_kpa=51.0)
    assert sample.supply_pressure_kpa == pytest.approx(199.0, abs=0.02)
    assert sample.chamber_pressure_kpa == pytest.approx(51.0, abs=0.005)
    assert sample.status == constant("PressureSample", "STATUS_OK")
    assert module.sample().seq == sample.seq + 1


def test_the_stamp_is_before_the_frame_was_on_the_wire(module):
    handed_ns = CLOCK.now_ns() - 50_000_000
    assert module.sample(stamp_ns=handed_ns).stamp_ns == handed_ns, "a frame that waited keeps its time"
    sample = module.sample(stamp_ns=CLOCK.now_ns() + 10**9)
    assert sample.stamp_ns == sample.received_ns - FRAME_NS, "and no stamp is of the future"
    assert sample.received_ns <= sample.published_ns


def test_gaps_of_the_counter_are_counted_and_repetitions_left_out(module):
    missed = module.sample().missed
    assert module.sample(step=4).missed == missed + 3
    count = len(module.samples.look())
    module.send(step=0)
    assert module.sample(step=252).missed == missed + 3 + 251
    assert len(module.samples.look()) == count + 1


@pytest.mark.parametrize("reading", [{"supply_kpa": 406.0}, {"supply_kpa": -6.0}, {"chamber_kpa": -6.0}])
def test_a_reading_outside_its_span_says_so(module, reading):
    assert module.sample(**reading).status == constant("PressureSample", "STATUS_OUT_OF_RANGE")
    assert module.sample().status == constant("PressureSample", "STATUS_OK")


def test_frames_that_are_none_of_the_module_are_dropped(module):
    count = len(module.samples.look())
    module.port.send(ANALOG_INPUTS_ID, b"\x00" * 7, CLOCK.now_ns())
    module.sample()
    assert len(module.samples.look()) == count + 1
    until(lambda: any(s.dropped == 1 for s in module.status.look()))


def test_a_silent_module_is_an_event_and_so_is_its_return(module):
    kind = constant("Event", "KIND_BUS")
    until(lambda: module.events.find(kind=kind, code=1))
    module.send()
    until(lambda: module.events.find(kind=kind, code=0))


def test_a_bus_that_is_not_there_is_one_line(meet, tmp_path):
    config = replace(CONFIG, bus=CanConfig(interface="nosuch"))
    with bench(meet) as (a, _), pytest.raises(Unavailable, match=r"^CAN interface 'nosuch' is not known; [^\n]+$"):
        run_to_its_end(pressures.run, config, a, tmp_path)


def test_adapters_without_kernels_are_light():
    imports = "import sys, softloop.devices.pressures, softloop.devices.inclinometer"
    code = imports + "; print({'numba', 'llvmlite', 'scipy'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "set()"
