"""What the doctor says of real devices: each CAN bus and the inclinometer, listened to at rest. Nothing is sent to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

from softloop.deploy.bench import Bench, process_config
from softloop.deploy.doctor_check import Check, Verdict, judged, worst
from softloop.devices.config import SensorConfig, sampler_bounds
from softloop.devices.inclinometer_setup import SerialSource
from softloop.devices.protocols import can_frames, wt931
from softloop.devices.protocols.quantise import counts_to_deg, counts_to_kpa
from softloop.devices.protocols.wire_time import can_frame_ns
from softloop.wire.can_config import CanConfig, open_port
from softloop.wire.can_frame import FLAG_ERROR
from softloop.wire.can_port import CanPort
from softloop.wire.channels import COMMAND, VALVES
from softloop.wire.clock import Clock, WallClock
from softloop.wire.errors import Lost, Unavailable
from softloop.wire.session import Wire

LOAD_WARN, LOAD_FAIL = 0.6, 0.85
RATE_PART = 0.1  # by how much a device on CAN may miss its rate
WAIT_S = 0.05
SHOWS_WITHIN_S = 1.0  # of silence at the start: an adapter that was just opened


def same_wire(plant_end: str, adapter_end: str) -> bool:
    """Whether the plant's address and an adapter's are the two ends of one simulated wire."""
    return plant_end.removeprefix("pty://").replace("listen://", "socket://") == adapter_end


def bus_is_simulated(bench: Bench, name: str) -> bool:
    """Whether the plant is what answers on `[can.NAME]`."""
    if bench.plant is None:
        return False
    ends = (bench.plant.can_valves, bench.plant.can_analog)
    return name in ends or any(same_wire(str(bench.can[end].channel), str(bench.can[name].channel)) for end in ends)


def inclinometer_is_simulated(bench: Bench) -> bool:
    return bench.plant is not None and bench.inclinometer is not None and same_wire(bench.plant.serial, bench.inclinometer.port)


def is_real(bench: Bench) -> bool:
    """Whether any device of the bench is a real one."""
    tables = [table.can for table in (bench.valves, bench.pressures) if table is not None]
    buses = any(not bus_is_simulated(bench, name) for name in tables)
    return buses or (bench.inclinometer is not None and not inclinometer_is_simulated(bench))


def devices(bench: Bench, wire: Wire, seconds: float, clock: Clock | None = None) -> list[Check]:
    """A check for each bus that a device process uses, and for the inclinometer; simulated ones are said to be so."""
    clock = clock or WallClock()
    checks = []
    for name in sorted({table.can for table in (bench.valves, bench.pressures) if table is not None}):
        if bus_is_simulated(bench, name):
            checks.append(Check(f"CAN {name}", "pass", "simulated by [plant]: no device to ask"))
        else:
            checks += can_checks(bench, name, wire, clock, seconds)
    if bench.inclinometer is not None:
        if inclinometer_is_simulated(bench):
            checks.append(Check("inclinometer", "pass", "simulated by [plant]: no device to ask"))
        else:
            checks.append(inclinometer(bench, clock, seconds))
    return checks


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

    def rate_hz(self, arbitration_id: int) -> float:
        return self.counts.get(arbitration_id, 0) / self.span_s if self.span_s > 0 else 0.0


def can_checks(bench: Bench, name: str, wire: Wire, clock: Clock, seconds: float) -> list[Check]:
    """Listen to a real bus: who speaks, how often, how full it is, and whether pressures are those of a rig at rest."""
    config = bench.can[name].model_copy(update={"mirror": False})
    try:
        port = open_port(config, name, wire, clock)
    except Unavailable as error:
        return [Check(f"CAN {name}", "fail", f"not there: {error}", _how_to_bring_up(config))]
    try:
        heard = listen(port, config.bitrate, clock, seconds)
    except Lost as error:
        return [Check(f"CAN {name}", "fail", str(error), "look at the adapter and its cable")]
    finally:
        port.close()
    checks = [answering(f"CAN {name}", heard, _expected_hz(bench, name)), load(f"CAN {name} load", heard, config.bitrate)]
    if bench.pressures is not None and bench.pressures.can == name and heard.analog:
        checks.append(at_rest(bench, heard.analog))
    return checks


def _how_to_bring_up(config: CanConfig) -> str:
    if config.interface == "socketcan":
        return f"plug in the adapter; as root: ip link set {config.channel} up type can bitrate {config.bitrate}"
    return "plug in the adapter; look at interface, channel and options in the bench file"


def _expected_hz(bench: Bench, name: str) -> dict[str, tuple[int, float]]:
    expected = {}
    if bench.valves is not None and bench.valves.can == name:
        expected["valve driver"] = (can_frames.VALVE_STATUS_ID, VALVES.rate_hz)
    if bench.pressures is not None and bench.pressures.can == name:
        expected["analogue module"] = (can_frames.ANALOG_INPUTS_ID, bench.pressures.rate_hz)
    return expected


def listen(port: CanPort, bitrate: int, clock: Clock, seconds: float) -> Heard:
    """All frames for `seconds` from the first one on. Raises Lost."""
    heard, last_error = Heard(), port.malformed
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
        heard.counts[frame.arbitration_id] = heard.counts.get(frame.arbitration_id, 0) + 1
        heard.busy_ns += can_frame_ns(frame.dlc, bitrate)
        if frame.arbitration_id == can_frames.ANALOG_INPUTS_ID and frame.dlc == can_frames.DLC and not frame.flags:
            heard.analog.append(can_frames.decode_analog_inputs(frame.data))
    heard.span_s = (clock.now_ns() - first_ns) * 1e-9 if first_ns else 0.0
    heard.malformed, heard.bus_off = port.malformed - last_error, port.bus_off
    return heard


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
    commands = (
        0.0 if can_frames.VALVE_COMMAND_ID in heard.counts else COMMAND.rate_hz * can_frame_ns(can_frames.DLC, bitrate) * 1e-9
    )
    verdict = judged(seen + commands, LOAD_WARN, LOAD_FAIL)
    found = f"{seen * 100:.0f} % now, {(seen + commands) * 100:.0f} % with the gate's commands"
    do = "raise the bit rate of all on the bus, or take other devices off it"
    return Check(name, verdict, found, "" if verdict == "pass" else do, {"load": seen, "load_with_commands": seen + commands})


def at_rest(bench: Bench, frames: list[can_frames.AnalogFrame]) -> Check:
    """Pressures of a rig at rest: in their sensors' range, and the chamber vented."""
    assert bench.pressures is not None
    supply = [_kpa(bench.pressures.supply, frame.supply_counts) for frame in frames]
    chamber = [_kpa(bench.pressures.chamber, frame.chamber_counts) for frame in frames]
    found = f"supply {min(supply):.1f} to {max(supply):.1f} kPa, chamber {min(chamber):.1f} to {max(chamber):.1f} kPa"
    measured = {"supply_kpa": [min(supply), max(supply)], "chamber_kpa": [min(chamber), max(chamber)]}
    if not (_in_range(bench.pressures.supply, supply) and _in_range(bench.pressures.chamber, chamber)):
        do = "a cut wire, or zero_v, full_v and span_kpa that are not this sensor's"
        return Check("pressures at rest", "fail", f"{found}: out of the sensor's range", do, measured)
    vented_kpa = bench.valves.vent_again_kpa if bench.valves is not None else bench.run.vented_kpa
    if max(chamber) > vented_kpa:
        return Check("pressures at rest", "warn", f"{found}: the chamber is not vented", "vent it, or look at zero_v", measured)
    return Check("pressures at rest", "pass", found, "", measured)


def _kpa(sensor: SensorConfig, counts: int) -> float:
    return float(counts_to_kpa(counts, sensor.zero_v, sensor.full_v, sensor.span_kpa))


def _in_range(sensor: SensorConfig, values_kpa: list[float]) -> bool:
    return -sensor.margin_kpa <= min(values_kpa) and max(values_kpa) <= sensor.span_kpa + sensor.margin_kpa


def inclinometer(bench: Bench, clock: Clock, seconds: float) -> Check:
    """Listen to a real inclinometer: rate, gaps, packets thrown away, and whether it stands still."""
    config = bench.inclinometer
    assert config is not None
    try:
        source = SerialSource(config.port, config.baud)
    except Unavailable as error:
        return Check("inclinometer", "fail", f"not there: {error}", "plug it in; look at [inclinometer] port and baud")
    try:
        samples, rejected, n_bytes = hear_samples(source, wt931.Sampler(sampler_bounds(config), config.baud), clock, seconds)
    except Lost as error:
        return Check("inclinometer", "fail", str(error), "look at its cable and adapter")
    finally:
        source.close()
    if len(samples) < 3:
        found = f"{n_bytes} bytes, no samples" if n_bytes else "no bytes"
        return Check(
            "inclinometer", "fail", found, f"is its power on, and its baud rate {config.baud}? `configure = true` sets it"
        )
    return judge_samples(bench, samples, rejected)


def hear_samples(
    source: SerialSource, sampler: wt931.Sampler, clock: Clock, seconds: float
) -> tuple[list[wt931.Sample], int, int]:
    """(samples, packets thrown away, bytes) of `seconds`; what waited at the start is passed over. Raises Lost."""
    sampler.feed(source.read(WAIT_S), clock.now_ns())
    samples: list[wt931.Sample] = []
    before, before_bytes = sampler.rejected, sampler.parser.taken
    end_ns = clock.now_ns() + round(seconds * 1e9)
    while clock.now_ns() < end_ns:
        data = source.read(WAIT_S)
        samples += sampler.feed(data, clock.now_ns()) if data else []
    return samples, sampler.rejected - before, sampler.parser.taken - before_bytes


def judge_samples(bench: Bench, samples: list[wt931.Sample], rejected: int) -> Check:
    """Rate and longest gap against the bench file and the gate's age budget; the angle's span against its noise."""
    config = bench.inclinometer
    assert config is not None
    stamps = [sample.stamp_ns for sample in samples]
    rate_hz = (len(stamps) - 1) * 1e9 / (stamps[-1] - stamps[0])
    gap_ms = max(later - earlier for earlier, later in pairwise(stamps)) * 1e-6
    angles = [float(counts_to_deg(sample.angle_counts)) for sample in samples]
    span_deg = max(angles) - min(angles)
    budget_ms = process_config(bench, "valves").inclination_age_ns * 1e-6 if bench.valves is not None else 30.0
    rate_off = abs(rate_hz - config.rate_hz) > config.rate_tolerance * config.rate_hz
    still: Verdict = "warn" if span_deg > 2 * config.noise_deg or rejected else "pass"
    verdict = worst(["fail" if rate_off else "pass", judged(gap_ms, 2e3 / config.rate_hz, budget_ms), still])
    found = (
        f"{rate_hz:.0f} Hz of {config.rate_hz}, longest gap {gap_ms:.1f} ms (budget {budget_ms:.1f}), "
        f"thrown away {rejected}, angle within {span_deg:.2f} deg"
    )
    do = "at rest? rate_hz and baud as the device has them (or configure = true); a USB adapter's latency timer at 1 ms"
    measured = {"rate_hz": rate_hz, "longest_gap_ms": gap_ms, "rejected": rejected, "angle_span_deg": span_deg}
    return Check("inclinometer", verdict, found, "" if verdict == "pass" else do, measured)
