"""`[recorder]`, `[monitor]`, `[page]` and `[foxglove]` of the bench file."""

from __future__ import annotations

from dataclasses import dataclass
from ipaddress import ip_address
from typing import Literal

from pydantic import Field, model_validator

from softloop.wire.benchfile import ProcessTable, Table


class RecorderConfig(ProcessTable):
    """`[recorder]`: what the log keeps, and how much the recorder may hold back before it has to drop."""

    file: str = Field("run.mcap", pattern=r"^[A-Za-z0-9_.-]+\.mcap$", description="name of the log in the run's directory")
    flush_s: float = Field(0.2, gt=0, le=60, description="how long a message may wait in memory: what a killed recorder costs")
    poll_s: float = Field(0.02, gt=0, le=1, description="how often arrived messages are taken")
    chunk_kib: int = Field(64, ge=4, le=4096, description="uncompressed size at which a chunk is closed")
    backlog_messages: int = Field(100_000, ge=1, le=10_000_000, description="messages waiting; beyond it the oldest go")
    unwritten_mib: int = Field(64, ge=1, le=4096, description="bytes the disk did not take yet; beyond it new messages go")
    drain_s: float = Field(3.0, ge=0, le=60, description="time allowed at the end for what is still waiting")
    budget_mib: int = Field(0, ge=0, description="disk space for this bench's runs in [run] folder; 0: no limit")
    over_budget: Literal["refuse", "remove"] = Field(
        "refuse", description="refuse: no new run; remove: the oldest runs go, never one that is in use or holds a file `keep`"
    )


class MonitorConfig(ProcessTable):
    """`[monitor]`: the invariants that a process watches at wall pace, and whether it faults the gate when one does not hold."""

    faults_gate: bool = Field(False, description="an invariant that does not hold leads the gate to FAULT, reason `invariant`")
    parameters: bool = Field(True, description="watch that every estimate is inside its set")
    command: bool = Field(True, description="watch that both currents are within saturation")
    error: bool = Field(True, description="watch the error on the trajectory; not with law pressure")
    error_max_deg: float = Field(30.0, gt=0, le=360, description="its envelope, either way")
    error_s: float = Field(0.1, ge=0, le=60, description="for how long it must be left")
    chatter: bool = Field(True, description="watch the changes of the working mode")
    switches_per_s: float = Field(80.0, gt=0, le=200, description="more of them within one second are chattering")
    bound: bool = Field(True, description="watch Eq. 50's ultimate bound where its assumptions hold; laws arc and smc")
    bound_margin: float = Field(1.5, ge=1, le=100, description="times the bound: sampling and delays are not in its proof")
    poll_s: float = Field(0.005, gt=0, le=1, description="how often arrived records are judged")


@dataclass(frozen=True)
class LawGains:
    """What Eq. 50's bound of a law follows from; see the law's table."""

    k1: float
    k2: float
    rho: float
    epsilon1: float
    epsilon2: float
    desired_max_kpa: float


@dataclass(frozen=True)
class MonitorProcess:
    """What the monitor is given: its table, and what it must know of the controller.

    Attributes:
        parameters: the controller's parameter file. law: gains of a law that Eq. 50 speaks of. angle: it follows an angle.
    """

    table: MonitorConfig
    parameters: str
    law: LawGains | None = None
    angle: bool = True


class PageConfig(Table):
    """`[page]`: the live page in a browser, served by `softloop page` and `softloop run --page`."""

    host: str = Field(
        "127.0.0.1", min_length=1, description="address to listen on; another than loopback needs the next three keys"
    )
    certificate: str = Field("", description="TLS: path of the certificate chain, PEM")
    key: str = Field("", description="TLS: path of its private key, PEM")
    token_file: str = Field("", description="path of a file with the token that a viewer has to bring, 16 characters or more")
    port: int = Field(8420, ge=0, le=65_534, description="0: a free one; the emergency stop has the next port for itself")
    history_s: float = Field(600.0, ge=1, le=3600, description="how much of the past a new viewer gets")

    @model_validator(mode="after")
    def _guarded(self) -> PageConfig:
        if bool(self.certificate) != bool(self.key):
            raise ValueError("certificate and key come together")
        if not self.loopback and not (self.certificate and self.token_file):
            raise ValueError(f"host {self.host} is not loopback: TLS and a token are needed (certificate, key and token_file)")
        return self

    @property
    def loopback(self) -> bool:
        """Nobody outside this machine can reach it."""
        try:
            return self.host == "localhost" or ip_address(self.host).is_loopback
        except ValueError:
            return False


class FoxgloveConfig(Table):
    """`[foxglove]`: the channels for Foxglove and Lichtblick, served on loopback by `softloop foxglove` and `run --foxglove`."""

    port: int = Field(8765, ge=0, le=65_535, description="0: a free one")
    rate_hz: float = Field(50.0, gt=0, le=1000, description="a faster channel is thinned to this; events and requests never")
