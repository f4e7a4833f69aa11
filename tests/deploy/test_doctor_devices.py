"""What the doctor makes of CAN buses and the inclinometer: each verdict on made-up findings, on both sides of its limit."""

import can
import pytest
from tests.devices.canopen_module import Module
from tests.wire.rendezvous import meeting

from softloop.deploy.doctor_can import STUCK_SAMPLES, Heard, answering, at_rest, can_checks, driver, load
from softloop.deploy.doctor_canopen import NAME as VENT_CHECK
from softloop.deploy.doctor_canopen import judge_settings, plan_on
from softloop.deploy.doctor_devices import bus_is_simulated, inclinometer_is_simulated, is_real
from softloop.deploy.doctor_inclinometer import _nothing_usable, judge_samples
from softloop.devices.canopen_node import talking
from softloop.devices.protocols import can_frames, wt931
from softloop.devices.protocols.canopen_output import required_settings
from softloop.devices.protocols.quantise import kpa_to_counts
from softloop.wire.can_config import open_port
from softloop.wire.clock import WallClock
from softloop.wire.session import open_wire

MS = 1_000_000
AT = can_frames.VALVE_STATUS_ID

# --- CAN


def heard(rate_hz=200.0, span_s=5.0, **more):
    counts = {can_frames.VALVE_STATUS_ID: round(rate_hz * span_s), can_frames.ANALOG_INPUTS_ID: round(200 * span_s)}
    return Heard(span_s=span_s, counts=counts, **more)


EXPECTED = {"valve driver": (can_frames.VALVE_STATUS_ID, 200.0)}


@pytest.mark.parametrize(
    ("found", "verdict", "said"),
    [
        (heard(), "pass", "200 Hz of 200"),
        (heard(rate_hz=185.0), "pass", "185 Hz"),
        (heard(rate_hz=170.0), "fail", "170 Hz"),
        (heard(rate_hz=0.0), "fail", "0 Hz"),
        (heard(errors=3), "warn", "error frames 3"),
        (heard(malformed=1), "warn", "malformed 1"),
        (heard(bus_off=True), "fail", "bus off"),
        (Heard(), "fail", "nobody speaks"),
    ],
)
def test_who_answers_on_a_bus(found, verdict, said):
    check = answering("CAN can0", found, EXPECTED)
    assert check.verdict == verdict
    assert said in check.found
    assert bool(check.do) == (verdict != "pass")


def test_the_load_counts_the_commands_that_are_not_there_yet():
    found = heard()
    found.busy_ns = round(0.5 * 5e9)
    quiet = load("l", found, 500_000)
    assert quiet.measured["load_with_commands"] > quiet.measured["load"] == pytest.approx(0.5)
    found.counts[can_frames.VALVE_COMMAND_ID] = 1000
    commanded = load("l", found, 500_000)
    assert commanded.measured["load_with_commands"] == commanded.measured["load"]
    found.busy_ns = round(0.9 * 5e9)
    assert load("l", found, 500_000).verdict == "fail"


def status_frames(state=can_frames.STATE_WATCHDOG, charge=0, exhaust=20_000, count=20):
    frames = [
        can_frames.encode_valve_status(can_frames.ValveStatusFrame(i % 15, state, charge, exhaust, 0)) for i in range(count)
    ]
    return heard(status=frames)


def test_a_driver_that_vents_by_itself_passes(bench):
    check = driver(bench(), status_frames())
    assert (check.verdict, check.do) == ("pass", "")
    assert check.measured["exhaust_coil_ma"] == 200.0


@pytest.mark.parametrize(
    ("frames", "verdict", "said"),
    [
        (status_frames(state=can_frames.STATE_OK), "fail", "its watchdog does not vent"),
        (status_frames(charge=3000), "fail", "its watchdog does not vent"),
        (status_frames(exhaust=15_000), "warn", "exhaust 150.0 mA"),
        (status_frames(exhaust=0), "fail", "exhaust 0.0 mA"),
    ],
)
def test_a_driver_that_does_not_vent_as_it_should(bench, frames, verdict, said):
    check = driver(bench(), frames)
    assert (check.verdict, bool(check.do)) == (verdict, True)
    assert said in check.found


def test_a_driver_with_broken_frames_and_one_that_is_commanded(bench):
    broken = status_frames()
    broken.status = [bytes([data[0] ^ 1]) + data[1:] for data in broken.status]
    assert "counter and CRC" in driver(bench(), broken).found
    some = status_frames()
    some.status[5] = bytes(8)
    assert driver(bench(), some).verdict == "warn"
    commanded = status_frames()
    commanded.counts[can_frames.VALVE_COMMAND_ID] = 5
    assert (driver(bench(), commanded).verdict, driver(bench(), commanded).found) == ("fail", "somebody else commands the valves")


def analog(chamber_kpa, supply_kpa=300.0, count=STUCK_SAMPLES, noise=16):
    counts = [kpa_to_counts(value, 0.0, 10.0, 250.0) for value in (min(supply_kpa, 250.0), chamber_kpa)]
    return [can_frames.AnalogFrame(counts[0], counts[1] + noise * (i % 2), i % 256) for i in range(count)]


def test_pressures_of_a_rig_at_rest(bench):
    assert at_rest(bench(), analog(0.3)).verdict == "pass"
    assert at_rest(bench(), analog(20.0)).verdict == "warn"
    stuck = at_rest(bench(), analog(0.0, noise=0))
    assert stuck.verdict == "warn"
    assert "does not move" in stuck.found
    assert at_rest(bench(), analog(0.0, noise=0, count=STUCK_SAMPLES - 1)).verdict == "pass"  # too few to tell


def test_a_cut_wire_of_a_live_zero_sensor_is_out_of_range(bench):
    check = at_rest(bench("[pressures.chamber]\nzero_v = 1.0\nfull_v = 5.0\n"), analog(0.0))
    assert check.verdict == "fail"
    assert "out of the sensor's range" in check.found


# --- inclinometer


def samples(rate_hz=200.0, angle=100, count=600, gap_at=None, gap_ms=0.0):
    found = []
    for i in range(count):
        late = round(gap_ms * MS) if gap_at is not None and i >= gap_at else 0
        stamp = round(i * 1e9 / rate_hz) + late
        found.append(wt931.Sample(wt931.SAMPLE, angle + i % 3, 0, stamp, stamp))
    return found


@pytest.mark.parametrize(
    ("heard_samples", "rejected", "verdict"),
    [
        (samples(), 0, "pass"),
        (samples(rate_hz=190.0), 0, "pass"),
        (samples(rate_hz=100.0), 0, "fail"),
        (samples(gap_at=300, gap_ms=8.0), 0, "warn"),
        (samples(gap_at=300, gap_ms=30.0), 0, "fail"),
        (samples(), 2, "warn"),
        (samples(angle=int(210 / 180 * 32768)), 0, "fail"),
        ([s._replace(angle_counts=10 * i) for i, s in enumerate(samples())], 0, "warn"),
    ],
)
def test_an_inclinometer_by_its_samples(bench, heard_samples, rejected, verdict):
    check = judge_samples(bench(), heard_samples, rejected)
    assert check.verdict == verdict, check.found
    assert bool(check.do) == (verdict != "pass")


def test_a_wrong_rate_is_no_failure_where_each_run_sets_it(bench):
    text = "[inclinometer]\nconfigure = true\n"
    assert judge_samples(bench(text), samples(rate_hz=100.0), 0).verdict == "warn"
    assert _nothing_usable(bench(text).inclinometer, 500).verdict == "warn"
    assert _nothing_usable(bench(text).inclinometer, 0).verdict == "fail"
    assert _nothing_usable(bench().inclinometer, 500).verdict == "fail"


# --- what is simulated


def test_what_is_simulated_and_what_is_real(bench):
    assert bus_is_simulated(bench(), "can0")
    assert inclinometer_is_simulated(bench())
    assert not is_real(bench())
    assert bus_is_simulated(bench(base="slcan"), "valve_bus")
    assert not is_real(bench(base="slcan"))
    assert is_real(bench(base="real"))
    mixed = bench('[inclinometer]\nport = "/dev/ttyUSB0"\n')
    assert is_real(mixed)
    assert not inclinometer_is_simulated(mixed)
    assert bus_is_simulated(mixed, "can0")


# --- a CANopen node as valve driver

NODE = (
    '[can.can0]\ninterface = "virtual"\nchannel = "examined"\n'
    '[valves]\ndriver = "canopen_analog"\n[valves.canopen_analog]\nnode_id = 7\n'
)


def test_a_node_that_would_not_vent_by_itself_fails_with_what_to_do(bench):
    plan = plan_on(bench(NODE), "can0")
    good = judge_settings(plan, 13, [])
    assert (good.verdict, "for 20 ms" in good.found) == ("pass", True)
    bad = judge_settings(plan, 13, ["1401h:05 (receive PDO: deadline): holds 0, must hold 20"])
    assert (bad.verdict, bad.measured) == ("fail", {"settings": 13, "wrong": 1})
    assert "holds 0, must hold 20" in bad.found
    assert "softloop canopen configure" in bad.do
    assert plan_on(bench(), "can0") is None
    assert plan_on(bench(NODE), "other") is None


@pytest.fixture
def node():
    with can.Bus(interface="virtual", channel="examined", ignore_config=True) as bus:
        module = Module(bus, 7)
        yield module
        module.close()


@pytest.fixture
def examined(bench):
    """The checks of the node's bus, by name, and a way to speak with the node."""
    there, clock = bench(NODE), WallClock()
    with meeting() as zenoh, open_wire(zenoh, "examined", "doctor") as wire:

        def configure():
            port = open_port(there.can["can0"].model_copy(update={"mirror": False}), "can0", wire, clock)
            with talking(port, 7, clock) as talk:
                talk.write(required_settings(plan_on(there, "can0")))
            port.close()

        yield lambda: {check.name: check for check in can_checks(there, "can0", wire, clock, 0.5)}, configure


def test_a_node_is_listened_to_and_asked(node, examined):
    """Before and after it is configured; its heartbeat is what it is known by."""
    look, configure = examined
    vent = look()[VENT_CHECK]
    assert (vent.verdict, bool(vent.do)) == ("fail", True)
    assert "1016h:01 (heartbeat consumer: the gate): holds 0" in vent.found
    configure()
    checks = look()
    assert checks[VENT_CHECK].verdict == "pass"
    assert checks["CAN can0"].measured["rates_hz"]["valve driver"] > 0
    assert "(id 0x707)" in checks["CAN can0"].found


def test_a_node_that_is_not_there_fails_twice(examined):
    checks = examined[0]()
    assert (checks["CAN can0"].verdict, checks[VENT_CHECK].verdict) == ("fail", "fail")
    assert "does not answer" in checks[VENT_CHECK].found
