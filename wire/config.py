"""wire's own tables of the bench file: `[zenoh]` and `[host]`."""

from __future__ import annotations

import os
import re
import tempfile
from ipaddress import ip_address
from pathlib import Path
from typing import Literal, Self

from pydantic import Field, field_validator, model_validator

from softloop.wire.benchfile import Table

_LOCAL = ("unixsock-stream/", "tcp/127.0.0.1:", "tcp/[::1]:", "tcp/localhost:")
TLS, QUIC = "tls/", "quic/"
SECURED = (TLS, QUIC)  # both are mutual TLS, over TCP and over UDP
IDENTITY = r"^[a-z0-9_-]{1,24}$"


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


def ip(address: str) -> str:
    """The address, which is empty or an IP address. Raises ValueError on any other."""
    try:
        ip_address(address.strip("[]") or "::1")
    except ValueError:
        raise ValueError("must be an IP address, such as 127.0.0.2") from None
    return address


def is_loopback(address: str) -> bool:
    """An IP address of this machine alone."""
    try:
        return ip_address(address.strip("[]")).is_loopback
    except ValueError:
        return False


class TlsConfig(Table):
    """`[zenoh.tls]`: mutual TLS and access rules, without which nothing listens off this machine; see docs/security.md."""

    folder: str = Field(min_length=1, description="where `softloop keys` puts the identities, and processes find theirs")
    operators: list[str] = Field(["operator"], description="people who may arm; they may also all that a guest may")
    guests: list[str] = Field(["guest"], description="people who may look on, and stop the rig")
    identity: str = Field(
        "", description="who a person's command is (request, top, page, ...); empty: the first of them whose key is in the folder"
    )
    names: list[str] = Field([], description="more names and addresses under which the bench's hosts are reached")
    valid_days: int = Field(365, ge=1, le=3650, description="how long an identity is good for")

    @field_validator("operators", "guests")
    @classmethod
    def _are_people(cls, value: list[str]) -> list[str]:
        from softloop.wire.rights import RIGHTS  # noqa: PLC0415 - a bench without TLS needs none

        for name in value:
            if not re.match(IDENTITY, name) or name in (*RIGHTS, "ca"):
                raise ValueError(f"'{name}': a name is of a-z, 0-9, _ and -, at most 24, and none of {', '.join(RIGHTS)}, ca")
        return value

    @model_validator(mode="after")
    def _says_who(self) -> Self:
        people = [*self.operators, *self.guests]
        if len(set(people)) < len(people):
            raise ValueError("somebody is named twice among operators and guests")
        if self.identity and self.identity not in people:
            raise ValueError(f"identity '{self.identity}' is none of operators and guests: {', '.join(people)}")
        return self


class ZenohConfig(Table):
    """`[zenoh]`: how the processes of a bench find each other."""

    mode: Literal["peer", "client"] = Field("peer", description="peer: direct links; client: all by way of the meeting point")
    endpoint: str = Field("", description="meeting point; empty: a Unix socket named after the bench")
    listen: str = Field("", description="peer: address of this host for direct links; empty: that of the meeting point")
    lease_ms: int = Field(5000, ge=50, le=60_000, description="a silent link is given up after this")

    tls: TlsConfig | None = None

    @field_validator("endpoint")
    @classmethod
    def _is_known(cls, value: str) -> str:
        if value and not value.startswith((*_LOCAL, *SECURED)):
            raise ValueError(f"must begin with one of {', '.join(_LOCAL)}, or, off this machine too, with {TLS} or {QUIC}")
        return value

    @field_validator("listen")
    @classmethod
    def _listens_on_this_machine(cls, value: str) -> str:
        return ip(value)

    @model_validator(mode="after")
    def _is_secured(self) -> Self:
        """Off this machine only with TLS; and TLS never by half."""
        if self.endpoint.startswith(SECURED) and self.tls is None:
            raise ValueError("an endpoint tls/... or quic/... needs the table [zenoh.tls]; see docs/security.md")
        if self.listen and self.tls is None and not is_loopback(self.listen):
            raise ValueError("an address off this machine to listen on needs the table [zenoh.tls]; see docs/security.md")
        if self.tls is not None and not self.endpoint.startswith(SECURED):
            raise ValueError("with [zenoh.tls] the endpoint must be tls/HOST:PORT or quic/HOST:PORT")
        return self

    def meeting_point(self, bench: str) -> str:
        return self.endpoint or default_endpoint(bench)

    @property
    def datagrams(self) -> bool:
        """Whether links can carry a message that is not sent again when it is lost."""
        return self.endpoint.startswith(QUIC)


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
