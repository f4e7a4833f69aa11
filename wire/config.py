"""wire's own tables of the bench file: `[zenoh]` and `[host]`."""

from __future__ import annotations

import os
import tempfile
from ipaddress import ip_address
from pathlib import Path
from typing import Literal

from pydantic import Field, field_validator

from softloop.wire.benchfile import Table

_LOCAL = ("unixsock-stream/", "tcp/127.0.0.1:", "tcp/[::1]:", "tcp/localhost:")


def runtime_dir() -> Path:
    """A folder of this user's for sockets: `$XDG_RUNTIME_DIR`, or one in the system's temporary folder."""
    base = os.environ.get("XDG_RUNTIME_DIR")
    if base and os.access(base, os.W_OK):
        return Path(base)
    path = Path(tempfile.gettempdir()) / f"softloop-{os.getuid()}"
    path.mkdir(mode=0o700, exist_ok=True)
    return path


def default_endpoint(bench: str) -> str:
    """Where a bench meets unless its file says otherwise: a Unix socket named after it."""
    return f"unixsock-stream/{runtime_dir()}/softloop-{bench}.sock"


def loopback(address: str) -> str:
    """The address, which is empty or an IP address of this machine alone. Raises ValueError on any other."""
    if address and not is_loopback(address):
        raise ValueError("must be a loopback address, such as 127.0.0.2")
    return address


def is_loopback(address: str) -> bool:
    """An IP address of this machine alone."""
    try:
        return ip_address(address.strip("[]")).is_loopback
    except ValueError:
        return False


class ZenohConfig(Table):
    """`[zenoh]`: how the processes of a bench find each other."""

    mode: Literal["peer", "client"] = Field("peer", description="peer: direct links; client: all by way of the meeting point")
    endpoint: str = Field("", description="meeting point; empty: a Unix socket named after the bench")
    listen: str = Field("", description="peer: address of this host for direct links; empty: that of the meeting point")
    lease_ms: int = Field(5000, ge=50, le=60_000, description="a silent link is given up after this")

    @field_validator("endpoint")
    @classmethod
    def _stays_on_this_machine(cls, value: str) -> str:
        if value and not value.startswith(_LOCAL):
            raise ValueError(f"must begin with one of {', '.join(_LOCAL)}")
        return value

    @field_validator("listen")
    @classmethod
    def _listens_on_this_machine(cls, value: str) -> str:
        return loopback(value)

    def meeting_point(self, bench: str) -> str:
        return self.endpoint or default_endpoint(bench)


class PaceConfig(Table):
    """`[pace]`: by which clock the processes go on together."""

    mode: Literal["wall", "lockstep"] = Field("wall", description="wall: the machine's clock; lockstep: tick by tick, all exact")
    software_latency_us: int = Field(
        600, ge=0, le=3000, description="lockstep: from a tick to its valve frame, what software takes at wall pace"
    )
    timeout_s: float = Field(10.0, gt=0, le=600, description="lockstep: a process that is silent for longer is lost")


class HostConfig(Table):
    """`[host]`: what the computer grants the processes of the 5 ms path."""

    realtime_priority: int = Field(50, ge=0, le=98, description="SCHED_FIFO priority; 0 asks for none")
    lock_memory: bool = Field(True, description="also lock memory; not asked for at priority 0")
