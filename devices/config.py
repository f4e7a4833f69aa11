"""devices' own tables of the bench file: `[valves]`, `[pressures]`, `[inclinometer]`, and what follows from them together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from pydantic import Field, model_validator

from softloop.devices.driver_config import CanopenAnalogConfig, CanopenCurrentConfig
from softloop.devices.protocols.analog import AnalogConfig
from softloop.devices.protocols.quantise import COUNTS_MAX, MA_PER_COUNT
from softloop.devices.protocols.wire_time import can_frame_ns, serial_ns
from softloop.devices.protocols.wt931 import (
    BANDWIDTH_CODES,
    BAUD_CODES,
    RATE_CODES,
    SAMPLE_BYTES,
    SamplerConfig,
    sampler_config,
)
from softloop.wire.benchfile import ProcessTable, Table
from softloop.wire.can_config import CanConfig
from softloop.wire.channels import COMMAND
from softloop.wire.errors import BadConfig

PERIOD_NS = round(1e9 / COMMAND.rate_hz)
ANALOG_DLC = 8


class ValvesConfig(ProcessTable):
    """`[valves]`: the safety gate and its valve driver."""

    can: str = Field("can0", description="which [can.NAME] the valve driver is on")
    driver: Literal["rig", "canopen_analog", "canopen_current"] = Field(
        "rig", description="rig: speaks rig.dbc; the others: a CANopen node, described in the table of that name"
    )
    canopen_analog: CanopenAnalogConfig = CanopenAnalogConfig()
    canopen_current: CanopenCurrentConfig = CanopenCurrentConfig()
    current_max_ma: float = Field(220.0, gt=0, le=COUNTS_MAX * MA_PER_COUNT, description="above it a command is a fault")
    slew_ma_per_tick: float = Field(220.0, ge=1.0, description="a passed current changes at most this much in one tick")
    overlap_ma: float = Field(70.0, ge=0, description="one of the two currents is always held at or below this")
    vent_current_ma: float = Field(200.0, gt=0, description="exhaust current while venting")
    vent_done_kpa: float = Field(2.0, ge=0, description="venting ends at this chamber pressure")
    vent_settle_s: float = Field(
        0.5, ge=0, le=10, description="and has stayed below it for so long: gas that expanded cold warms up and rises again"
    )
    vent_again_kpa: float = Field(10.0, gt=0, description="and begins again above this one")
    vent_time_s: float = Field(10.0, ge=1.0, description="or after this time, unless vent_again_kpa is seen")
    pressure_max_kpa: float = Field(190.0, gt=0, description="chamber pressure; above it is a fault")
    angle_min_deg: float = Field(-20.0, description="below it is a fault")
    angle_max_deg: float = Field(200.0, description="above it is a fault")
    hold_ticks: int = Field(3, ge=0, le=20, description="so many ticks without a command the last one is held; then a fault")
    path_delay_ms: float = Field(2.0, ge=0, le=1000, description="declared, adapters, Zenoh and controller, from sensor to gate")
    age_ticks: int = Field(3, ge=0, le=20, description="slack in the sensors' age budgets")
    command_wait_ms: float = Field(1.5, gt=0, le=5, description="a command later than this costs its tick")
    # Longer than the driver's own watchdog, which vents by itself when the gate is not heard: a silent driver is one whose
    # currents are not seen, and a computer that stands still for 30 ms is not one.
    driver_silence_ms: float = Field(50.0, ge=5, le=1000, description="without a good status frame for this long: a fault")
    driver_max_lost: int = Field(3, ge=1, le=13, description="so many status frames lost in a row make the next one refused")

    @model_validator(mode="after")
    def _agrees_with_itself(self) -> ValvesConfig:
        if self.vent_current_ma > self.current_max_ma:
            raise ValueError(f"vent_current_ma must be at most current_max_ma ({self.current_max_ma:g})")
        if self.vent_again_kpa <= self.vent_done_kpa:
            raise ValueError(f"vent_again_kpa must be above vent_done_kpa ({self.vent_done_kpa:g})")
        if self.vent_again_kpa >= self.pressure_max_kpa:
            raise ValueError(f"vent_again_kpa must be below pressure_max_kpa ({self.pressure_max_kpa:g})")
        if self.angle_min_deg >= self.angle_max_deg:
            raise ValueError(f"angle_min_deg must be below angle_max_deg ({self.angle_max_deg:g})")
        if self.node is not None:
            self._agrees_with_node(self.node)
        return self

    @property
    def node(self) -> CanopenAnalogConfig | None:
        """The CANopen node that drives the valves; None for the rig's own driver."""
        return {"canopen_analog": self.canopen_analog, "canopen_current": self.canopen_current}.get(self.driver)

    def _agrees_with_node(self, node: CanopenAnalogConfig) -> None:
        if node.full_ma < self.current_max_ma:
            raise ValueError(f"current_max_ma must be at most {self.driver}.full_ma ({node.full_ma:g})")
        if node.plan(self.vent_current_ma).error_counts[1] == node.off_counts:
            raise ValueError(f"vent_current_ma must be a current that {self.driver} can give (low_ma is {node.low_ma:g})")
        for name, least_ms in (("deadline_ms", node.deadline_ms), ("heartbeat_ms", 2 * node.heartbeat_ms)):
            if least_ms >= self.driver_silence_ms:
                raise ValueError(f"{self.driver}.{name} is too long for driver_silence_ms ({self.driver_silence_ms:g})")


class SensorConfig(Table):
    """One pressure sensor: gauge pressure = (volts - zero_v) / (full_v - zero_v) * span_kpa."""

    zero_v: float = Field(0.0, ge=-10, le=10, description="the sensor's output at 0 kPa gauge")
    full_v: float = Field(10.0, ge=-10, le=10, description="its output at span_kpa; above zero_v")
    span_kpa: float = Field(250.0, gt=0, le=10_000, description="gauge pressure at full_v")
    margin_kpa: float = Field(5.0, ge=0, description="a reading further than this outside 0..span_kpa is out of range")

    @model_validator(mode="after")
    def _has_a_slope(self) -> SensorConfig:
        if self.full_v <= self.zero_v:
            raise ValueError(f"full_v must be above zero_v ({self.zero_v:g})")
        return self


class PressuresConfig(ProcessTable):
    """`[pressures]`: the analogue module with the two pressure sensors."""

    can: str = Field("can0", description="which [can.NAME] the analogue module is on")
    rate_hz: float = Field(200.0, gt=0, le=1000, description="frames per second of the module")
    supply: SensorConfig = SensorConfig()
    chamber: SensorConfig = SensorConfig()


class InclinometerConfig(ProcessTable):
    """`[inclinometer]`: the WT931 on a serial port."""

    port: str = Field(min_length=1, description="a device such as /dev/ttyUSB0, or a pyserial URL")
    baud: int = Field(115_200, description="of the WT931's BAUD register")
    rate_hz: int = Field(200, description="of its RRATE register")
    bandwidth_hz: int = Field(256, description="of its BANDWIDTH register")
    configure: bool = Field(False, description="write baud, rate, bandwidth and content to the device at the start")
    configure_baud: int | None = Field(None, description="the baud rate at which it listens before that; default: baud")
    open_wait_s: float = Field(10.0, ge=0, le=600, description="how long a port that is not there yet is waited for at the start")
    direction: Literal[1, -1] = Field(1, description="-1 when it is mounted the other way round")
    zero_deg: float = Field(0.0, ge=-360, le=360, description="its angle, after direction, where bending is 0")
    max_rate_deg_s: float = Field(1000.0, gt=0, description="a packet that would need more is not believed")
    max_acceleration_deg_s2: float = Field(20_000.0, gt=0, description="likewise for the rate")
    noise_deg: float = Field(1.0, ge=0, description="what noise may add to one step of the angle")
    noise_deg_s: float = Field(20.0, ge=0, description="and of the rate")
    rate_tolerance: float = Field(0.1, gt=0, lt=1, description="part of rate_hz by which the measured rate may differ")

    @model_validator(mode="after")
    def _device_can_do_it(self) -> InclinometerConfig:
        tables = {"baud": BAUD_CODES, "configure_baud": BAUD_CODES, "rate_hz": RATE_CODES, "bandwidth_hz": BANDWIDTH_CODES}
        for name, codes in tables.items():
            value = getattr(self, name)
            if value is not None and value not in codes:
                raise ValueError(f"{name} must be one of {', '.join(map(str, codes))} (got {value})")
        if serial_ns(SAMPLE_BYTES, self.baud) * self.rate_hz > 1_000_000_000:
            raise ValueError(f"baud {self.baud} is too slow for {self.rate_hz} samples of {SAMPLE_BYTES} bytes per second")
        return self


def age_budget_ns(sample_period_ns: int, wire_ns: int, path_delay_ns: int, slack_ns: int) -> int:
    """How old a sensor's sample may be when the command that answers it reaches the gate.

    Its parts, in the order of the chain: the sample can be one sensor period old when the controller ticks, because the
    sensor runs on its own clock; it was on its wire for `wire_ns` after the stamp; adapters, Zenoh and the controller take
    the declared path delay; the rest is slack: ticks on which a sample may be lost or late.
    """
    return sample_period_ns + wire_ns + path_delay_ns + slack_ns


@dataclass(frozen=True)
class ValvesProcess:
    """What the process `valves` is given."""

    valves: ValvesConfig
    bus: CanConfig
    pressure_age_ns: int
    inclination_age_ns: int


@dataclass(frozen=True)
class PressuresProcess:
    """What the process `pressures` is given."""

    pressures: PressuresConfig
    bus: CanConfig


def valves_process(
    valves: ValvesConfig, pressures: PressuresConfig, inclinometer: InclinometerConfig, buses: Mapping[str, CanConfig]
) -> ValvesProcess:
    """The gate's config with the age budgets that follow from the sensors' tables.

    Raises:
        BadConfig: an unknown bus, or limits that the sensors cannot see passed.
    """
    limit_kpa = pressures.chamber.span_kpa + pressures.chamber.margin_kpa
    if valves.pressure_max_kpa >= limit_kpa:
        raise BadConfig(f"key 'valves.pressure_max_kpa': must be below what the chamber sensor can read ({limit_kpa:g} kPa)")
    path_ns, slack_ns = round(valves.path_delay_ms * 1e6), valves.age_ticks * PERIOD_NS
    analog_ns = can_frame_ns(ANALOG_DLC, bus_of(buses, "pressures", pressures.can).bitrate)
    bytes_ns = serial_ns(SAMPLE_BYTES, inclinometer.baud)
    return ValvesProcess(
        valves,
        bus_of(buses, "valves", valves.can),
        age_budget_ns(round(1e9 / pressures.rate_hz), analog_ns, path_ns, slack_ns),
        age_budget_ns(round(1e9 / inclinometer.rate_hz), bytes_ns, path_ns, slack_ns),
    )


def pressures_process(pressures: PressuresConfig, buses: Mapping[str, CanConfig]) -> PressuresProcess:
    """The config of `pressures` with its bus. Raises BadConfig on an unknown bus."""
    return PressuresProcess(pressures, bus_of(buses, "pressures", pressures.can))


def analog_config(config: PressuresProcess) -> AnalogConfig:
    """The bounds of `analog_step` that follow from the bench file."""
    supply, chamber = config.pressures.supply, config.pressures.chamber
    return AnalogConfig(
        can_frame_ns(ANALOG_DLC, config.bus.bitrate),
        -supply.margin_kpa,
        supply.span_kpa + supply.margin_kpa,
        -chamber.margin_kpa,
        chamber.span_kpa + chamber.margin_kpa,
    )


def sampler_bounds(config: InclinometerConfig) -> SamplerConfig:
    """What the bench file says of believable packets."""
    return sampler_config(
        config.rate_hz, config.max_rate_deg_s, config.noise_deg, config.max_acceleration_deg_s2, config.noise_deg_s
    )


def bus_of(buses: Mapping[str, CanConfig], table: str, name: str) -> CanConfig:
    """The bus that a process's table names. Raises BadConfig when there is none of that name."""
    if name not in buses:
        raise BadConfig(f"key '{table}.can': there is no [can.{name}]; there are: {', '.join(sorted(buses)) or '(none)'}")
    return buses[name]
