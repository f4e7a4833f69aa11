"""`[faults]` of the bench file: what is injected on the host's side while a bench runs, and where.

What breaks inside the simulated rig stands in `[[plant.faults]]`. What stands here is done to what devices and processes say to
each other, by the process that hears or says it, so that it works on real devices too; or, by the launcher, to processes.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from softloop.wire.benchfile import Table
from softloop.wire.channels import COMMAND, INCLINATION, PRESSURE, VALVES
from softloop.wire.messages import message

ALWAYS_S = 1e9
LATEST_S = 1e8  # three years; in nanoseconds it fits into 64 bits with all that is added to it
LINE_ACTIONS = ("drop", "delay", "duplicate", "reorder", "corrupt")
# Kinds whose size means something, and what. All others have none; `corrupt` may have one.
SIZED = {"delay": "ms", "step": "ms", "bias": "kPa, deg or deg/s", "noise": "its standard deviation"}
# Action, or target of a sensor's, -> the largest size and what that is: beyond it nothing more goes wrong, so it is a typo.
SIZES_MOST: dict[str, tuple[int, str]] = {
    "delay": (60_000, "ms, a minute: what is later than that is lost"),
    "step": (3_600_000, "ms, an hour: what a wrong time of summer steps by"),
    "chamber_pressure": (1_000, "kPa: far above any supply"),
    "supply_pressure": (1_000, "kPa: far above any supply"),
    "angle": (360, "deg: from any angle to any other"),
    "rate": (1_000, "deg/s: far above what an actuator turns with"),
}
CAN_BITS, BYTE_BITS = 64, 8
# Target -> the process that injects. A bus in time is the plant's.
CAN_TARGETS = {"analog": "pressures", "driver": "valves", "command": "valves"}
BABBLE_TARGETS = ("first", "last")  # in arbitration
BUS_TARGETS = dict.fromkeys((*CAN_TARGETS, *BABBLE_TARGETS), "plant")
SERIAL_TARGETS = {"inclinometer": "inclinometer"}
ZENOH_TARGETS = {"pressure": "pressures", "inclination": "inclinometer", "command": "controller", "valves": "valves"}
ZENOH_BITS = {c.name: 8 * message(c.message).cdr_size for c in (PRESSURE, INCLINATION, COMMAND, VALVES)}
SENSOR_TARGETS = {
    "chamber_pressure": "pressures", "supply_pressure": "pressures", "angle": "inclinometer", "rate": "inclinometer",
}  # fmt: skip
PROCESSES = ("plant", "valves", "pressures", "inclinometer", "controller", "recorder")
LAUNCHER = "launcher"
TARGETS: dict[str, dict[str, str]] = {
    "can": CAN_TARGETS,
    "bus": BUS_TARGETS,
    "serial": SERIAL_TARGETS,
    "zenoh": ZENOH_TARGETS,
    "sensor": SENSOR_TARGETS,
    "process": dict.fromkeys(PROCESSES, LAUNCHER),
    "clock": {name: name for name in ("valves", "pressures", "inclinometer", "controller")},
    "disk": {"recorder": LAUNCHER},
    "router": {"": LAUNCHER},
}

Kind = Literal[
    "can_drop", "can_delay", "can_duplicate", "can_reorder", "can_corrupt", "can_error_frames", "can_bus_off",
    "bus_disturb", "bus_babble",
    "serial_drop", "serial_delay", "serial_duplicate", "serial_reorder", "serial_corrupt",
    "zenoh_drop", "zenoh_delay", "zenoh_duplicate", "zenoh_reorder", "zenoh_corrupt",
    "sensor_stuck", "sensor_bias", "sensor_noise", "sensor_nan",
    "process_kill", "process_stop", "process_restart", "clock_step", "disk_full", "router_loss",
]  # fmt: skip


class InjectionFields(Table):
    """What an injection consists of, in a bench file and in a scenario."""

    kind: str = Field(description="what goes wrong; docs/faults.md lists the kinds")
    target: str = Field("", description="where: a wire, a channel, a sensor's value or a process, as docs/faults.md lists them")
    at_s: float = Field(ge=0, le=LATEST_S, description="when it begins")
    duration_s: float = Field(ALWAYS_S, gt=0, le=ALWAYS_S, description="default: it stays")
    probability: float = Field(1.0, gt=0, le=1, description="how likely each frame, byte, sample or value is hit")
    size: float = Field(0.0, description="delay, step: ms; bias: kPa, deg, deg/s; noise: its deviation; corrupt: bits, 0 is one")


class InjectionConfig(InjectionFields):
    """One thing that goes wrong between devices and processes. Times count from the instant at which the gate is armed."""

    kind: Kind = Field(description="what goes wrong; docs/faults.md lists the kinds")

    @property
    def family(self) -> str:
        """What it is done to: can, bus, serial, zenoh, sensor, process, clock, disk, router."""
        return self.kind.partition("_")[0]

    @property
    def action(self) -> str:
        """What is done."""
        return self.kind.partition("_")[2]

    @property
    def process(self) -> str:
        """The process that does it."""
        return TARGETS[self.family][self.target]

    @property
    def has_chance(self) -> bool:
        """It hits things one by one, each with its probability."""
        return self.family in ("can", "serial", "zenoh", "sensor") or self.kind == "bus_disturb"

    @property
    def needs_wall(self) -> bool:
        """It is done to a process or to its clock, which at lockstep pace wait for each other."""
        return self.process == LAUNCHER or self.family == "clock"

    @model_validator(mode="after")
    def _makes_sense(self) -> InjectionConfig:
        allowed = TARGETS[self.family]
        if self.target not in allowed:
            names = ", ".join(name for name in allowed if name) or "(none)"
            raise ValueError(f"kind '{self.kind}' has no target '{self.target}'; it has: {names}")
        if self.family == "bus" and (self.target in BABBLE_TARGETS) != (self.action == "babble"):
            names = ", ".join(BABBLE_TARGETS if self.action == "babble" else CAN_TARGETS)
            raise ValueError(f"kind '{self.kind}' has no target '{self.target}'; it has: {names}")
        if self.target == "command" and self.action in ("error_frames", "bus_off"):
            raise ValueError(f"kind '{self.kind}' has no target 'command'; a node's trouble is that of target 'driver'")
        self._check_size()
        if self.probability != 1.0 and not self.has_chance:
            raise ValueError(f"kind '{self.kind}' has no probability")
        return self

    def _check_size(self) -> None:
        if (self.action in SIZED) != (self.size != 0.0) and self.action != "corrupt":
            needs = f"needs a size ({SIZED[self.action]})" if self.action in SIZED else "has no size"
            raise ValueError(f"kind '{self.kind}' {needs}")
        if self.size < 0 and self.action not in ("bias", "step"):
            raise ValueError(f"size of '{self.kind}' must be above 0, got {self.size:g}")
        if self.action == "corrupt" and not self.size.is_integer():
            raise ValueError(f"size of '{self.kind}' must be a whole number of bits, got {self.size:g}")
        most, what = self._most() if self.size else (0, "")
        if abs(self.size) > most:
            raise ValueError(f"size of '{self.kind}' must be at most {most} ({what}), got {self.size:g}")

    def _most(self) -> tuple[int, str]:
        """The largest size of a kind that has one, either way, and what that is."""
        if self.action == "corrupt":
            whole = {"can": (CAN_BITS, "bits: a whole CAN frame"), "serial": (BYTE_BITS, "bits: a whole byte")}
            return whole.get(self.family) or (ZENOH_BITS[self.target], "bits: a whole message")
        return SIZES_MOST[self.target if self.family == "sensor" else self.action]


class FaultsConfig(Table):
    """`[faults]`: what is injected on the host's side, each a `[[faults.injections]]`; see docs/faults.md."""

    seed: int = Field(1, ge=0, description="of what is left to chance; equal seeds give equal injections at lockstep pace")
    injections: tuple[InjectionConfig, ...] = Field(
        (), max_length=32, description="what goes wrong, each a [[faults.injections]]"
    )

    def of_process(self, process: str) -> list[tuple[int, InjectionConfig]]:
        """(place in the list, injection) of all that a process injects."""
        return [(i, injection) for i, injection in enumerate(self.injections) if injection.process == process]
