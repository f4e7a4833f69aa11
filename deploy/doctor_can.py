"""What the doctor says of a CAN bus: who speaks, how full it is, and whether driver and sensors say what a rig at rest says.

Only listened to: nothing is sent, but questions to a CANopen node (`doctor_canopen`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from softloop.deploy.bench import Bench
from softloop.deploy.doctor_canopen import own_vent, plan_on
from softloop.deploy.doctor_check import Check, Verdict, judged, worst
from softloop.devices.config import SensorConfig
from softloop.devices.protocols import can_frames
from softloop.devices.protocols.quantise import counts_to_current, counts_to_kpa
from softloop.devices.protocols.wire_time import can_frame_ns
from softloop.wire.can_config import CanConfig, open_port
from softloop.wire.can_frame import FLAG_ERROR
from softloop.wire.can_port import CanPort
from softloop.wire.channels import COMMAND, VALVES
from softloop.wire.clock import Clock
from softloop.wire.errors import Lost, Unavailable
from softloop.wire.session import Wire

LOAD_WARN, LOAD_FAIL = 0.6, 0.85
RATE_PART = 0.1  # by how much a device on CAN may miss its rate
WAIT_S = 0.05
SHOWS_WITHIN_S = 1.0  # of silence at the start: an adapter that was just opened
STUCK_SAMPLES = 100  # so many equal readings in a row: a sensor with noise does not give them
SHUT_MA = 5.0  # a coil that carries less is without current, its measurement's zero error included
VENT_PART = 0.1  # by how much the exhaust coil may miss its vent current


@dataclass
class Heard:
    """What went by on a bus."""

    span_s: float = 0.0
    counts: dict[int, int] = field(default_factory=dict)  # arbitration id -> frames
    busy_ns: int = 0
    errors: int = 0
    malformed: int = 0
    bus_off: bool = False
    analog: list[can_frames.AnalogFrame] = field(default_factory=list)
    status: list[bytes] = field(default_factory=list)  # data of the valve driver's frames

    def rate_hz(self, arbitration_id: int) -> float:
        return self.counts.get(arbitration_id, 0) / self.span_s if self.span_s > 0 else 0.0

    @property
    def commanded(self) -> bool:
        """Whether somebody sends valve commands."""
        return can_frames.VALVE_COMMAND_ID in self.counts


def can_checks(bench: Bench, name: str, wire: Wire, clock: Clock, seconds: float) -> list[Check]:
    """All checks of the bus of table `[can.NAME]`."""
    config = bench.can[name].model_copy(update={"mirror": False})
    try:
        port = open_port(config, name, wire, clock)
    except Unavailable as error:
        return [Check(f"CAN {name}", "fail", f"not there: {error}", _how_to_bring_up(config))]
    plan = plan_on(bench, name)
    try:
        heard = listen(port, config.bitrate, clock, seconds)
        asked = [own_vent(plan, port, clock)] if plan is not None else []
    except Lost as error:
        return [Check(f"CAN {name}", "fail", str(error), "look at the adapter and its cable")]
    finally:
        port.close()
    checks = [answering(f"CAN {name}", heard, _expected_hz(bench, name)), load(f"CAN {name} load", heard, config.bitrate), *asked]
    if bench.valves is not None and bench.valves.can == name and heard.status and plan is None:
        checks.append(driver(bench, heard))
    if bench.pressures is not None and bench.pressures.can == name and heard.analog:
        checks.append(at_rest(bench, heard.analog))
    return checks


def _how_to_bring_up(config: CanConfig) -> str:
    if config.interface == "socketcan":
        return f"plug in the adapter; as root: ip link set {config.channel} up type can bitrate {config.bitrate}"
    return "plug in the adapter; look at interface, channel and options in the bench file"


def _expected_hz(bench: Bench, name: str) -> dict[str, tuple[int, float]]:
    expected = {}
    plan = plan_on(bench, name)
    if plan is not None:
        expected["valve driver"] = (plan.heartbeat_id, 1e3 / plan.heartbeat_ms)
    elif bench.valves is not None and bench.valves.can == name:
        expected["valve driver"] = (can_frames.VALVE_STATUS_ID, VALVES.rate_hz)
    if bench.pressures is not None and bench.pressures.can == name:
        expected["analogue module"] = (can_frames.ANALOG_INPUTS_ID, bench.pressures.rate_hz)
    return expected


def listen(port: CanPort, bitrate: int, clock: Clock, seconds: float) -> Heard:
    """All frames for `seconds` from the first one on. Raises Lost."""
    heard, malformed_before = Heard(), port.malformed
    began_ns = clock.now_ns()
    first_ns = 0
    while clock.now_ns() - (first_ns or began_ns) < (seconds if first_ns else max(seconds, SHOWS_WITHIN_S)) * 1e9:
        frame = port.recv(WAIT_S)
        if frame is None:
            continue
        if frame.flags & FLAG_ERROR:
            heard.errors += 1
            continue
        first_ns = first_ns or clock.now_ns()
        _note(heard, frame.arbitration_id, bytes(frame.data[: frame.dlc]), bitrate, plain=not frame.flags)
    heard.span_s = (clock.now_ns() - first_ns) * 1e-9 if first_ns else 0.0
    heard.malformed, heard.bus_off = port.malformed - malformed_before, port.bus_off
    return heard


def _note(heard: Heard, arbitration_id: int, data: bytes, bitrate: int, *, plain: bool) -> None:
    heard.counts[arbitration_id] = heard.counts.get(arbitration_id, 0) + 1
    heard.busy_ns += can_frame_ns(len(data), bitrate)
    if not plain or len(data) != can_frames.DLC:
        return
    if arbitration_id == can_frames.ANALOG_INPUTS_ID:
        heard.analog.append(can_frames.decode_analog_inputs(data))
    elif arbitration_id == can_frames.VALVE_STATUS_ID:
        heard.status.append(data)


def answering(name: str, heard: Heard, expected: Mapping[str, tuple[int, float]]) -> Check:
    """Whether the devices that should be on a bus speak, at their rates."""
    rates = {who: heard.rate_hz(arbitration_id) for who, (arbitration_id, _) in expected.items()}
    measured = {"rates_hz": rates, "error_frames": heard.errors, "malformed": heard.malformed, "bus_off": heard.bus_off}
    if heard.bus_off or not heard.counts:
        found = "bus off" if heard.bus_off else "nobody speaks"
        return Check(name, "fail", found, "device power, both terminators, CAN-H and CAN-L, the bit rate of all", measured)
    verdicts: list[Verdict] = ["warn" if heard.errors or heard.malformed else "pass"]
    words, todo = [], "a worn cable or a wrong bit rate: look at both" if verdicts[0] == "warn" else ""
    for who, (arbitration_id, wanted_hz) in expected.items():
        off = abs(rates[who] - wanted_hz) > RATE_PART * wanted_hz
        words.append(f"{who} (id 0x{arbitration_id:x}) {rates[who]:.0f} Hz of {wanted_hz:g}")
        verdicts.append("fail" if off else "pass")
        todo = f"look at the {who}: power, its identifier, its cycle time" if off else todo
    found = f"{', '.join(words)}; error frames {heard.errors}, malformed {heard.malformed}"
    return Check(name, worst(verdicts), found, todo, measured)


def load(name: str, heard: Heard, bitrate: int) -> Check:
    """How full a bus is, each frame at its longest; with the gate's frames, which are not on it yet."""
    seen = heard.busy_ns * 1e-9 / heard.span_s if heard.span_s > 0 else 0.0
    commands = 0.0 if heard.commanded else COMMAND.rate_hz * can_frame_ns(can_frames.DLC, bitrate) * 1e-9
    verdict = judged(seen + commands, LOAD_WARN, LOAD_FAIL)
    found = f"{seen * 100:.0f} % now, {(seen + commands) * 100:.0f} % with the gate's commands"
    do = "raise the bit rate of all on the bus, or take other devices off it"
    return Check(name, verdict, found, "" if verdict == "pass" else do, {"load": seen, "load_with_commands": seen + commands})


def driver(bench: Bench, heard: Heard) -> Check:
    """The valve driver without commands: its own watchdog must vent, and its frames must be good ones."""
    assert bench.valves is not None
    name = "valve driver at rest"
    receiver = can_frames.E2eReceiver(can_frames.VALVE_STATUS_ID, bench.valves.driver_max_lost)
    good = [data for data in heard.status if receiver.judge(data).usable]
    measured: dict[str, Any] = {"frames": len(heard.status), "refused": receiver.rejected, "commanded": heard.commanded}
    if not good:
        return Check(name, "fail", "none of its frames has a right counter and CRC", "see rig.dbc: E2E profile 1", measured)
    if heard.commanded:
        do = "look for a second gate, on another computer or under another name"
        return Check(name, "fail", "somebody else commands the valves", do, measured)
    last = can_frames.decode_valve_status(good[-1])
    charge_ma, exhaust_ma = counts_to_current(last.charge_counts), counts_to_current(last.exhaust_counts)
    measured |= {"state": last.state, "charge_coil_ma": charge_ma, "exhaust_coil_ma": exhaust_ma}
    found = f"charge {charge_ma:.1f} mA, exhaust {exhaust_ma:.1f} mA, refused {receiver.rejected} of {len(heard.status)} frames"
    if last.state != can_frames.STATE_WATCHDOG or charge_ma > SHUT_MA:
        do = "do not run: the driver must vent by itself within 20 ms without commands; see docs/safety.md"
        return Check(name, "fail", f"{found}: its watchdog does not vent", do, measured)
    off = abs(exhaust_ma - bench.valves.vent_current_ma) > VENT_PART * bench.valves.vent_current_ma
    if off or receiver.rejected:
        do = "the driver's own vent current as [valves] vent_current_ma; refused frames: the cable"
        return Check(name, "fail" if exhaust_ma <= SHUT_MA else "warn", found, do, measured)
    return Check(name, "pass", f"its watchdog vents: {found}", "", measured)


def at_rest(bench: Bench, frames: list[can_frames.AnalogFrame]) -> Check:
    """Pressures of a rig at rest: in their sensors' range, alive, and the chamber vented."""
    assert bench.pressures is not None
    name, sensors = "pressures at rest", bench.pressures
    supply = [_kpa(sensors.supply, frame.supply_counts) for frame in frames]
    chamber = [_kpa(sensors.chamber, frame.chamber_counts) for frame in frames]
    found = f"supply {min(supply):.1f} to {max(supply):.1f} kPa, chamber {min(chamber):.1f} to {max(chamber):.1f} kPa"
    measured = {"supply_kpa": [min(supply), max(supply)], "chamber_kpa": [min(chamber), max(chamber)]}
    if not (_in_range(sensors.supply, supply) and _in_range(sensors.chamber, chamber)):
        do = "a cut wire, or zero_v, full_v and span_kpa that are not this sensor's"
        return Check(name, "fail", f"{found}: out of the sensor's range", do, measured)
    vented_kpa = bench.valves.vent_again_kpa if bench.valves is not None else bench.run.vented_kpa
    if max(chamber) > vented_kpa:
        return Check(name, "warn", f"{found}: the chamber is not vented", "vent it, or look at zero_v", measured)
    if len(frames) >= STUCK_SAMPLES and min(chamber) == max(chamber):
        do = "press the actuator by hand: a reading that does not move is a cut wire or a dead sensor"
        return Check(name, "warn", f"{found}: the chamber's reading does not move at all", do, measured)
    return Check(name, "pass", found, "", measured)


def _kpa(sensor: SensorConfig, counts: int) -> float:
    return float(counts_to_kpa(counts, sensor.zero_v, sensor.full_v, sensor.span_kpa))


def _in_range(sensor: SensorConfig, values_kpa: list[float]) -> bool:
    return -sensor.margin_kpa <= min(values_kpa) and max(values_kpa) <= sensor.span_kpa + sensor.margin_kpa
