"""`[can.NAME]` of the bench file, and how an adapter opens and uses any CAN bus."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from pydantic import Field, field_validator, model_validator

from softloop.wire.benchfile import Table
from softloop.wire.channels import node_of
from softloop.wire.errors import Unavailable

if TYPE_CHECKING:  # reading a bench file needs none of these
    import can

    from softloop.wire.can_port import CanPort
    from softloop.wire.clock import Clock
    from softloop.wire.session import Wire

_LOOK_AGAIN_S = 0.05
_OWN_KEYS = ("interface", "channel", "bitrate", "can_filters", "session", "bench", "node", "congestion", "through_bus")


class EmulationConfig(Table):
    """`[can.NAME.emulation]`: a bus in time instead of a pipe. The simulated rig holds it; all nodes' frames go through it."""

    restart_ms: float = Field(100.0, ge=0, le=60_000, description="a node that went off the bus comes back by itself; 0: never")
    queue_frames: int = Field(64, ge=1, le=4096, description="of one node that wait for the bus at most; more are refused")
    error_rate: float = Field(0.0, ge=0, le=0.5, description="how likely a transmission is destroyed by chance")
    seed: int = Field(1, ge=0, description="of that chance")
    bus_errors: bool = Field(False, description="also tell a node of each failed transmission; wall pace only")


class CanConfig(Table):
    """`[can.NAME]`: which bus. What is simulated or real differs here and nowhere else."""

    interface: str = Field("zenoh", min_length=1, description="a python-can interface: zenoh, socketcan, slcan, pcan, ...")
    channel: str | int = Field("can0", description="the bus of that interface: can0, /dev/ttyACM0, PCAN_USBBUS1, ...")
    bitrate: int = Field(500_000, ge=10_000, le=1_000_000, description="bit/s")
    send_timeout_ms: float = Field(2.0, gt=0, le=1000, description="a frame the bus has not taken by then is given up")
    open_wait_s: float = Field(0.0, ge=0, le=600, description="how long a device file that is not there yet is waited for")
    mirror: bool = Field(True, description="also publish the frames of a bus that is not on Zenoh, for the log")
    options: dict[str, Any] = Field(default_factory=dict, description="more arguments of the python-can interface")
    emulation: EmulationConfig | None = None

    @field_validator("options")
    @classmethod
    def _leaves_own_keys_alone(cls, value: dict[str, Any]) -> dict[str, Any]:
        taken = sorted(set(value) & set(_OWN_KEYS))
        if taken:
            raise ValueError(f"{', '.join(taken)} cannot stand in options")
        return value

    @model_validator(mode="after")
    def _emulates_what_is_not_there(self) -> CanConfig:
        if self.emulation is not None and self.interface != "zenoh":
            raise ValueError(f"emulation is for interface 'zenoh'; '{self.interface}' is a bus of its own")
        return self


def open_bus(config: CanConfig, wire: Wire, receive: Sequence[int] | None = None) -> can.BusABC:
    """Open the bus that `config` names.

    Args:
        receive: the standard arbitration ids to receive; None for all frames. Error frames come in any case.

    Raises:
        Unavailable: one line that says why there is no such bus, and which interfaces there are.
    """
    import can  # noqa: PLC0415 - a bench file is read by many who need no bus

    import softloop.wire.serial_urls  # noqa: F401, PLC0415 - a serial adapter's channel may be one of our URLs

    arguments: dict[str, Any] = dict(config.options)
    if config.interface == "zenoh":
        name = str(config.channel)
        node = wire.node_on(name) if config.emulation is None else node_of(wire.bench, wire.process, name)
        arguments |= {"session": wire.session, "bench": wire.bench, "node": node, "congestion": wire.congestion}
        arguments["through_bus"] = config.emulation is not None
    if receive is not None:
        arguments["can_filters"] = [{"can_id": i, "can_mask": 0x7FF, "extended": False} for i in receive]
    # Only what the bench file says: python-can's own configuration files and variables are left out.
    arguments |= {"interface": config.interface, "channel": config.channel, "bitrate": config.bitrate, "ignore_config": True}
    if config.interface not in can.VALID_INTERFACES:
        there = ", ".join(sorted(can.VALID_INTERFACES))
        raise Unavailable(f"CAN interface '{config.interface}' is not known; there are: {there}")
    _wait_for_device(config)
    try:
        return can.Bus(**arguments)
    except Exception as error:  # noqa: BLE001 - each driver has errors of its own kind; a person gets one line
        raise Unavailable(f"CAN bus {config.interface}:{config.channel}: {one_line(error)}") from None


def _wait_for_device(config: CanConfig) -> None:
    """Until the device file that `channel` names is there, so that whoever makes it may start later."""
    end = time.monotonic() + config.open_wait_s
    while str(config.channel).startswith("/") and not os.path.exists(str(config.channel)) and time.monotonic() < end:
        time.sleep(_LOOK_AGAIN_S)


def open_port(config: CanConfig, name: str, wire: Wire, clock: Clock, receive: Sequence[int] | None = None) -> CanPort:
    """Open the bus of table `[can.NAME]` as an adapter uses it. Arguments and errors as `open_bus`."""
    from softloop.wire.can_port import CanPort  # noqa: PLC0415 - as in open_bus

    bus = open_bus(config, wire, receive)
    return CanPort(bus, name, wire, clock, send_timeout_s=config.send_timeout_ms * 1e-3, mirror=config.mirror)


def one_line(error: BaseException) -> str:
    """What an error says, in one line; its kind where it says nothing."""
    lines = str(error).strip().splitlines()
    return lines[0][:200] if lines else type(error).__name__
