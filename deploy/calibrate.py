"""`softloop calibrate`: listens to a rig at rest, or at a known point, and writes what follows as a piece of a bench file."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import tomlkit

from softloop.deploy.bench import Bench
from softloop.deploy.calibration import (
    Found,
    inclinometer_sign,
    inclinometer_zero,
    joined,
    sensor_gain,
    sensor_zero,
    volts_of,
)
from softloop.deploy.device_access import AtRest, bench_at_rest
from softloop.deploy.doctor_can import SHUT_MA, Heard, listen
from softloop.deploy.doctor_inclinometer import hear_samples
from softloop.devices.config import sampler_bounds
from softloop.devices.inclinometer_setup import SerialSource
from softloop.devices.protocols import can_frames, wt931
from softloop.devices.protocols.quantise import counts_to_current
from softloop.wire.benchfile import read_toml
from softloop.wire.can_config import open_port
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK, BadConfig, Unavailable

HEAD = '# Written by `softloop calibrate`. A bench file takes it over with: pieces = ["{name}"]\n'


@dataclass(frozen=True)
class Known:
    """What a person says of the rig while it is listened to; None for nothing.

    Attributes:
        supply_vented: nothing is on the supply sensor.
        rest_deg: the bending angle at rest.
        chamber_kpa, supply_kpa: by a manometer.
        bent_deg: the bending angle, bent by hand.
    """

    supply_vented: bool = False
    rest_deg: float | None = None
    chamber_kpa: float | None = None
    supply_kpa: float | None = None
    bent_deg: float | None = None

    @property
    def point(self) -> bool:
        """Whether it is a known point, and not the vented rig at rest."""
        return not (self.chamber_kpa is None and self.supply_kpa is None and self.bent_deg is None)

    def check(self) -> None:
        """Raises BadConfig when rest and a known point are asked for at once, or one of them is no finite number."""
        for name in ("rest_deg", "chamber_kpa", "supply_kpa", "bent_deg"):
            said = getattr(self, name)
            if said is not None and not isfinite(said):
                raise BadConfig(f"--{name.replace('_', '-')}: {said} is not a finite number; give one")
        if self.point and (self.supply_vented or self.rest_deg is not None):
            raise BadConfig(
                "--supply-vented and --rest-deg are of the rig at rest, --chamber-kpa, --supply-kpa and --bent-deg of a "
                "known point: one after the other"
            )


def calibrate(bench_file: Path, output: Path, known: Known, seconds: float) -> int:
    """Listen, say what was found, and write it; EXIT_NEGATIVE, and nothing written, when it cannot be.

    Raises:
        BadFile, BadConfig: the bench file, or a piece that `output` is already, is wrong.
        Unavailable, Lost: a device or its bus is not there; the bench is running; `output` cannot be written.
    """
    known.check()
    with bench_at_rest(bench_file) as rest:
        _check_piece(output, rest.bench)
        found = joined([*_pressures(rest, known, seconds), *_angle(rest, known, seconds)])
    for line in found.lines:
        print(line)
    for why in found.refused:
        print(f"refused: {why}")
    if found.refused or not found.keys:
        print(f"{output}: nothing written")
        return EXIT_NEGATIVE
    write_piece(output, found.keys)
    print(f'{output}: written; the bench takes it with pieces = ["{output.name}"]')
    return EXIT_OK


def _pressures(rest: AtRest, known: Known, seconds: float) -> list[Found]:
    sensors = rest.bench.pressures
    if sensors is None or (known.point and known.chamber_kpa is None and known.supply_kpa is None):
        return []
    heard = _hear(rest, sensors.can, seconds)
    supply = volts_of([frame.supply_counts for frame in heard.analog])
    chamber = volts_of([frame.chamber_counts for frame in heard.analog])
    found = [_nobody_commands(heard)]
    if not known.point:
        found.append(sensor_zero("chamber", sensors.chamber, chamber))
        found += [sensor_zero("supply", sensors.supply, supply)] if known.supply_vented else []
    if known.chamber_kpa is not None:
        found.append(sensor_gain("chamber", sensors.chamber, chamber, known.chamber_kpa))
    if known.supply_kpa is not None:
        found.append(sensor_gain("supply", sensors.supply, supply, known.supply_kpa))
    return found


def _hear(rest: AtRest, name: str, seconds: float) -> Heard:
    config = rest.bench.can[name].model_copy(update={"mirror": False})
    port = open_port(config, name, rest.wire, rest.clock)
    try:
        return listen(port, config.bitrate, rest.clock, seconds)
    finally:
        port.close()


def _nobody_commands(heard: Heard) -> Found:
    """That the rig is at rest as far as its own driver tells: no commands, and no current in the charge coil."""
    found = Found()
    if heard.commanded:
        found.refuse("somebody commands the valves")
    if heard.status:
        last = can_frames.decode_valve_status(heard.status[-1])
        charge_ma = counts_to_current(last.charge_counts)
        found.lines.append(f"valve driver: charge coil {charge_ma:.2f} mA at rest")
        if charge_ma > SHUT_MA:
            found.refuse(f"the charge coil carries {charge_ma:.1f} mA: the rig is not at rest, or the driver's zero is off")
    return found


def _angle(rest: AtRest, known: Known, seconds: float) -> list[Found]:
    config = rest.bench.inclinometer
    if config is None or (known.rest_deg is None and known.bent_deg is None):
        return []
    source = SerialSource(config.port, config.baud)
    try:
        samples, _, _ = hear_samples(source, wt931.Sampler(sampler_bounds(config), config.baud), rest.clock, seconds)
    finally:
        source.close()
    counts = [sample.angle_counts for sample in samples]
    if known.bent_deg is not None:
        return [inclinometer_sign(config, counts, known.bent_deg)]
    assert known.rest_deg is not None
    return [inclinometer_zero(config, counts, known.rest_deg)]


def _check_piece(output: Path, bench: Bench) -> None:
    """A piece that is there must be one the bench has taken over: what is measured now stands on it. Raises BadConfig."""
    if not output.exists():
        return
    for table, keys in _flat(read_toml(output)).items():
        held: Any = bench.model_dump()
        for part in table.split("."):
            held = held.get(part) or {}
        for key, value in keys.items():
            if held.get(key) != value:
                raise BadConfig(
                    f"{output}: key '{table}.{key}': the bench has {held.get(key)}; take the piece over first: "
                    f'pieces = ["{output.name}"]'
                )


def _flat(content: dict[str, Any], where: str = "") -> dict[str, dict[str, Any]]:
    """Table name -> its own keys."""
    own = {key: value for key, value in content.items() if not isinstance(value, dict)}
    found = {where: own} if own else {}
    for key, value in content.items():
        if isinstance(value, dict):
            found |= _flat(value, f"{where}.{key}" if where else key)
    return found


def write_piece(output: Path, keys: dict[tuple[str, str], float]) -> None:
    """Put keys into a piece of a bench file, over what it has. Raises BadFile when it is no TOML, Unavailable."""
    content = read_toml(output) if output.exists() else {}
    for (table, key), value in keys.items():
        place = content
        for part in table.split("."):
            place = place.setdefault(part, {})
        place[key] = value
    try:
        output.write_text(HEAD.format(name=output.name) + tomlkit.dumps(content), encoding="utf-8")
    except OSError as error:
        raise Unavailable(f"{output}: cannot be written: {error.strerror or error}") from None
