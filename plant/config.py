"""`[plant]` of the bench file: the simulated rig."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Literal, Self

from pydantic import Field, model_validator

from softloop.devices.protocols.wt931 import BANDWIDTH_CODES, BAUD_CODES, RATE_CODES
from softloop.wire.benchfile import ProcessTable, Table
from softloop.wire.can_config import CanConfig
from softloop.wire.errors import BadConfig

LEAST_TANK_ML = 100.0
SUPPLY_KPA = (20.0, 240.0)  # a regulated supply is set above the first and to no more than the second, gauge
# Kind of fault -> the least and the largest size: kPa and deg/s far above what the rig has, from any angle to any other, noise in
# which no signal is left, a hole wider than any hose. Beyond that nothing more breaks, so it is a typo.
FAULT_SIZES = {
    "chamber_bias": (-1000, 1000), "angle_bias": (-360, 360), "rate_bias": (-1000, 1000), "noise": (0, 1000),
    "supply_loss": (0, 1), "hose_burst": (0, 100), "charge_leak": (0, 100),
}  # fmt: skip


class SensorConfig(Table):
    """A pressure sensor as its data sheet has it; the rig layer adds this specimen's errors."""

    zero_v: float = Field(0.0, description="output at 0 kPa gauge")
    full_v: float = Field(10.0, description="output at span_kpa; above zero_v")
    span_kpa: float = Field(250.0, gt=0, description="gauge pressure at full_v less that at zero_v")

    @model_validator(mode="after")
    def _usable(self) -> SensorConfig:
        if not self.full_v > self.zero_v:
            raise ValueError(f"full_v must be above zero_v, got {self.full_v} and {self.zero_v}")
        return self


class LoadConfig(Table):
    """A payload or a contact that comes and goes. Times count from the plant's start, when its process enters its loop."""

    kind: Literal["payload", "contact"] = Field(description="a weight that is lifted, or a wall that is bent against")
    on_s: float = Field(ge=0, description="when it comes")
    off_s: float = Field(1e9, gt=0, description="default: it stays")
    size: float = Field(gt=0, description="payload: deg/s2 at 90 deg; contact: stiffness in deg/s2 per deg")
    angle_deg: float = Field(90.0, description="contact: where the wall stands")

    @model_validator(mode="after")
    def _ordered(self) -> LoadConfig:
        if not self.on_s < self.off_s:
            raise ValueError(f"on_s must be before off_s, got {self.on_s} and {self.off_s}")
        return self


class FaultConfig(Table):
    """Something that breaks, and perhaps is whole again. Times count from what `faults_from` says."""

    kind: Literal[
        "chamber_bias", "chamber_stuck", "analog_silent", "angle_bias", "rate_bias", "angle_stuck", "inclinometer_silent",
        "noise", "commands_lost", "driver_silent", "supply_loss", "hose_burst", "charge_stuck", "exhaust_stuck", "power_loss",
        "charge_leak",
    ] = Field(description="what breaks; see docs/exactness.md")  # fmt: skip
    on_s: float = Field(ge=0, le=1e9, description="when it breaks")
    off_s: float = Field(1e9, gt=0, le=2e9, description="default: it stays broken")
    size: float = Field(0.0, description="bias: kPa, deg, deg/s; noise: times the own; supply_loss: part; others: mm2")

    @model_validator(mode="after")
    def _makes_sense(self) -> FaultConfig:
        if not self.on_s < self.off_s:
            raise ValueError(f"on_s must be before off_s, got {self.on_s} and {self.off_s}")
        if (self.kind in FAULT_SIZES) != (self.size != 0.0):
            raise ValueError(f"kind '{self.kind}' {'needs a' if self.kind in FAULT_SIZES else 'has no'} size")
        least, most = FAULT_SIZES.get(self.kind, (0, 0))
        if not least <= self.size <= most:
            raise ValueError(f"size of '{self.kind}' is out of range, which is {least} to {most}, got {self.size:g}")
        return self


class SpecimenConfig(ProcessTable):
    """The keys that `[plant]` and `[shadow]` share: which specimen of a rig is simulated, and with which sensors."""

    layer: Literal["ideal", "rig"] = Field("rig", description="ideal: the controller's own model; rig: also what that leaves out")
    seed: int = Field(1, ge=0, description="which specimen of a rig, and its noise")
    parameters: str = Field("table1", description="parameter file about which the rig is drawn: a path, or a shipped name")
    step_us: int = Field(400, ge=10, le=1000, description="longest integration step; pieces between events are shorter")
    supply_sensor: SensorConfig = SensorConfig()
    chamber_sensor: SensorConfig = SensorConfig()
    supply_kpa: float | None = Field(
        None, gt=SUPPLY_KPA[0], le=SUPPLY_KPA[1], description="what the supply is set to, gauge; default: drawn by seed"
    )
    tank_ml: float = Field(0.0, ge=0, le=20_000, description="a rigid, isothermal tank on the port, not the actuator; 0: none")
    ambient_c: float | None = Field(None, ge=-20, le=60, description="of room, air and silicone; default: drawn by seed")
    pressure_rise_ms: float = Field(3.0, ge=0, description="10 to 90 % of the sensors; none in the ideal layer")
    bandwidth_hz: int = Field(256, description="of the inclinometer as it leaves the shelf")
    command_delay_ms: float = Field(0.0, ge=0, le=1000, description="added to the wire to the driver, for latency studies")

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if 0.0 < self.tank_ml < LEAST_TANK_ML:
            raise ValueError(f"tank_ml must be 0 or at least {LEAST_TANK_ML:g}: its tubing alone has 10 ml")
        _check_device("bandwidth_hz", self.bandwidth_hz, BANDWIDTH_CODES)
        return self


def _check_device(name: str, value: int, codes: Collection[int]) -> None:
    if value not in codes:
        raise ValueError(f"{name} must be one of {', '.join(map(str, codes))}")


class PlantConfig(SpecimenConfig):
    """`[plant]`: which rig is simulated, and on which wires."""

    can_valves: str = Field("can0", description="which [can.NAME] the simulated valve driver is on")
    can_analog: str = Field("can0", description="which [can.NAME] the simulated analogue module is on")
    serial: str = Field("pty://{run_dir}/inclinometer", description="where the inclinometer's bytes go, a pyserial URL")
    baud: int = Field(115_200, description="of the inclinometer as it leaves the shelf")
    rate_hz: int = Field(200, description="of the inclinometer as it leaves the shelf")

    pressure_noise_kpa: float = Field(0.1, ge=0, description="standard deviation of a pressure reading's noise")
    angle_noise_deg: float = Field(0.05, ge=0, description="likewise of the inclinometer's angle")
    rate_noise_deg_s: float = Field(0.1, ge=0, description="likewise of its rate")
    coil_noise_ma: float = Field(0.05, ge=0, description="likewise of the coil currents that the driver measures")

    vent_current_ma: float = Field(200.0, ge=0, description="exhaust current of the driver's own vent")
    dump_valve: bool = Field(False, description="a normally-open valve that vents the chamber when the driver has no power")
    watchdog_ms: float = Field(20.0, gt=0, description="the driver vents by itself after this time without a good frame")
    measurement_delay_ms: float = Field(0.0, ge=0, le=1000, description="added to the wires from the sensors and the driver")

    loads: tuple[LoadConfig, ...] = Field((), max_length=16, description="payloads and contacts, each a [[plant.loads]]")
    faults: tuple[FaultConfig, ...] = Field((), max_length=16, description="what breaks and when, each a [[plant.faults]]")
    faults_from: Literal["start", "armed"] = Field(
        "start", description="what the times of faults count from: the plant's start, or the gate's arming (wall pace)"
    )

    @model_validator(mode="after")
    def _known_device_settings(self) -> Self:
        _check_device("baud", self.baud, BAUD_CODES)
        _check_device("rate_hz", self.rate_hz, RATE_CODES)
        return self


@dataclass(frozen=True)
class PlantProcess:
    """What the process `plant` is given."""

    plant: PlantConfig
    valves_bus: CanConfig
    analog_bus: CanConfig


def emulated_buses(plant: PlantConfig, buses: Mapping[str, CanConfig]) -> tuple[str, ...]:
    """The names of the emulated buses that the plant holds, in the order of `CanBusStatus.bus`."""
    held = dict.fromkeys((plant.can_valves, plant.can_analog))
    return tuple(name for name in held if name in buses and buses[name].emulation is not None)


def plant_process(plant: PlantConfig, buses: Mapping[str, CanConfig]) -> PlantProcess:
    """The config of `plant` with its buses. Raises BadConfig on an unknown bus."""
    for key in ("can_valves", "can_analog"):
        name = getattr(plant, key)
        if name not in buses:
            raise BadConfig(f"key 'plant.{key}': there is no [can.{name}]; there are: {', '.join(sorted(buses)) or '(none)'}")
    return PlantProcess(plant, buses[plant.can_valves], buses[plant.can_analog])
