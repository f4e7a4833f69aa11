"""The parameter file: its tables with their bounds, and their checks. No kernels, so that processes without any can read it."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from pydantic import Field, model_validator

from softloop.wire.benchfile import Table, load_model, read_toml


class Bounded(Table):
    """A value with the bounds between which adaptation may move it (Eq. 29)."""

    value: float
    min: float
    max: float

    @model_validator(mode="after")
    def _ordered(self) -> Bounded:
        if not self.min <= self.value <= self.max:
            raise ValueError(f"impossible bounds: need min <= value <= max, got {self.min}, {self.value}, {self.max}")
        return self


class Bending(Table):
    """Coefficients of Eqs. 3 to 5; a in 1/s2, b in deg/(s2 kPa), c in 1/s, d in deg/s2, each per deg^index."""

    a0: Bounded
    a1: Bounded
    a2: Bounded
    b0: Bounded
    c0: Bounded
    c1: Bounded
    c2: Bounded
    c3: Bounded
    d: Bounded


class Valve(Table):
    """Coefficients of Eq. 16 of one valve."""

    k_v1_m2_ma: Bounded
    k_v2_pa: float = Field(ge=0)
    k_v3_m2_pa: float = Field(ge=0)
    k_v4_pa: float = Field(ge=0)
    k_v5_m2_pa: float = Field(ge=0)
    k_v6_m2: Bounded
    area_max_m2: float = Field(gt=0)


class Pneumatics(Table):
    """What Eqs. 11 to 21 need beside the valves."""

    volume_m3: float = Field(gt=0)
    temperature_k: float = Field(gt=200, lt=400)
    discharge: float = Field(gt=0, le=1, description="C_f")
    supply_kpa: float = Field(gt=0, description="regulated supply, gauge")
    current_max_ma: float = Field(gt=0)
    leak_m2: Bounded


class EvidenceRun(Table):
    """One run that the values were fitted to or tried on."""

    name: str
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$", description="of the log file")
    start_s: float = Field(description="the window that counted, from the run's first tick")
    end_s: float
    fit_percent: float = Field(description="NRMSE fit of a free simulation; of flow tests, of their flow")
    trained: bool
    log_problems: tuple[str, ...] = Field((), description="what is damaged or missing in the log file")
    evidence_problems: tuple[str, ...] = Field((), description="what speaks against the run as evidence; empty: nothing")


class Evidence(Table):
    """Where the bending values come from, and the valves' where a tank was used.

    The bounds of the bending hold three standard errors of what its values do together.
    """

    rig: str = Field(description="identity of the rig, as its bench says it: run.rig, or the bench's name")
    method: str = Field(description="estimator, and what its residuals were taken for")
    softloop: str = Field(description="version that identified")
    parameters: tuple[str, ...] = Field(description="order of the covariance")
    covariance: tuple[tuple[float, ...], ...]
    runs: tuple[EvidenceRun, ...]

    @model_validator(mode="after")
    def _square(self) -> Evidence:
        size = len(self.parameters)
        if len(self.covariance) != size or any(len(row) != size for row in self.covariance):
            raise ValueError(f"covariance must be {size} by {size}, the number of its parameters")
        return self


class Parameters(Table):
    """A parameter file."""

    name: str
    bending: Bending
    charge: Valve
    exhaust: Valve
    pneumatics: Pneumatics
    evidence: Evidence | None = None

    @model_validator(mode="after")
    def _usable(self) -> Parameters:
        if self.bending.b0.min <= 0 or self.charge.k_v1_m2_ma.min <= 0 or self.exhaust.k_v1_m2_ma.min <= 0:
            raise ValueError("impossible bounds: b0 and both k_v1 must stay above 0, the control law divides by them")
        for valve in (self.charge, self.exhaust):
            if valve.k_v2_pa * 1000.0 * self.pneumatics.supply_kpa >= 1.0:
                raise ValueError("k_v2 times the supply pressure must stay under 1, or Eq. 16 has no meaning")
        return self


def shipped(name: str = "table1") -> Path:
    """Path of a parameter file that comes with the package."""
    return Path(str(resources.files("softloop.dynamics") / "data" / f"{name}.toml"))


def load_parameters(path: Path) -> Parameters:
    """Read a parameter file. Raises BadFile or BadConfig with one line that says what is wrong."""
    return load_model(Parameters, read_toml(path), path)


def in_theta_order(parameters: Parameters) -> list[tuple[float, float, float]]:
    """(value, lowest, highest) of each place of theta."""
    bending, charge, exhaust = parameters.bending, parameters.charge, parameters.exhaust
    entries = [bending.a0, bending.a1, bending.a2, bending.c0, bending.c1, bending.c2, bending.c3, bending.d, bending.b0]
    entries += [charge.k_v1_m2_ma, charge.k_v6_m2, parameters.pneumatics.leak_m2, exhaust.k_v1_m2_ma, exhaust.k_v6_m2]
    ordered = [(e.value, e.min, e.max) for e in entries]
    for index in (1, 4):  # theta_2 = -a1 and theta_5 = -c1: the sign turns the bounds round
        value, low, high = ordered[index]
        ordered[index] = (-value, -high, -low)
    return ordered
