"""The bounds by which two runs of one excitation are the same rig, as far as can be measured: a TOML file."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from softloop.wire.benchfile import Table, load_model, read_toml
from softloop.wire.errors import BadFile


class EstimateConfig(Table):
    """`[estimate]`: how spectra are taken."""

    segment_s: float = Field(8.0, ge=1, le=120, description="length of a Hann segment, half overlapped; 2.5 must fit")
    excited_db: float = Field(-20.0, gt=-80, lt=0, description="a frequency is excited when this near the strongest, run A")
    delay_max_s: float = Field(
        0.5, gt=0, le=5, description="delays are looked for up to this, either way; half a segment at most"
    )

    @model_validator(mode="after")
    def _leaves_a_segment(self) -> Self:
        if self.delay_max_s > 0.5 * self.segment_s:
            raise ValueError(f"delay_max_s must be at most half of segment_s ({self.segment_s:g})")
        return self


class ExcitationConfig(Table):
    """`[excitation]`: what still counts as the same reference, or the same commands where the law has no reference."""

    reference_max_deg: float = Field(0.01, gt=0, description="laws that follow an angle")
    reference_max_kpa: float = Field(0.01, gt=0, description="laws that follow a pressure")
    command_max_ma: float = Field(1.0, gt=0, description="laws that follow neither")
    differs_max_percent: float = Field(1.0, ge=0, le=100, description="of the time, more than that apart")


class ChannelBounds(Table):
    """What every channel may be bounded by; a key that is left out is shown and not judged."""

    coherence_min: float | None = Field(None, gt=0, le=1, description="magnitude squared, over the excited band")
    delay_max_ms: float | None = Field(None, gt=0, description="of run B behind run A, either way")
    gain_error_max_percent: float | None = Field(None, gt=0, description="of run B over run A, from 1, either way")

    @property
    def residual_rms_max(self) -> float | None:
        """The bound on the RMS of B less A, in the channel's unit."""
        raise NotImplementedError

    @property
    def judges(self) -> bool:
        """At least one key is given."""
        return any(value is not None for value in self.model_dump().values())


class AngleBounds(ChannelBounds):
    """`[angle]`."""

    residual_rms_max_deg: float | None = Field(None, gt=0, description="RMS of B less A")

    @property
    def residual_rms_max(self) -> float | None:
        return self.residual_rms_max_deg


class RateBounds(ChannelBounds):
    """`[rate]`."""

    residual_rms_max_deg_s: float | None = Field(None, gt=0, description="RMS of B less A")

    @property
    def residual_rms_max(self) -> float | None:
        return self.residual_rms_max_deg_s


class PressureBounds(ChannelBounds):
    """`[chamber_pressure]` and `[supply_pressure]`."""

    residual_rms_max_kpa: float | None = Field(None, gt=0, description="RMS of B less A")

    @property
    def residual_rms_max(self) -> float | None:
        return self.residual_rms_max_kpa


class CurrentBounds(ChannelBounds):
    """`[charge_current]`, `[exhaust_current]`, `[charge_coil]` and `[exhaust_coil]`."""

    residual_rms_max_ma: float | None = Field(None, gt=0, description="RMS of B less A")

    @property
    def residual_rms_max(self) -> float | None:
        return self.residual_rms_max_ma


class ParityBounds(Table):
    """A whole file of bounds; a table per channel."""

    estimate: EstimateConfig = EstimateConfig()
    excitation: ExcitationConfig = ExcitationConfig()
    angle: AngleBounds = AngleBounds()
    rate: RateBounds = RateBounds()
    chamber_pressure: PressureBounds = PressureBounds()
    supply_pressure: PressureBounds = PressureBounds()
    charge_current: CurrentBounds = CurrentBounds()
    exhaust_current: CurrentBounds = CurrentBounds()
    charge_coil: CurrentBounds = CurrentBounds()
    exhaust_coil: CurrentBounds = CurrentBounds()

    def of(self, channel: str) -> ChannelBounds:
        """The bounds of a channel."""
        found: ChannelBounds = getattr(self, channel)
        return found

    @model_validator(mode="after")
    def _judges_something(self) -> Self:
        if not any(isinstance(table, ChannelBounds) and table.judges for table in vars(self).values()):
            raise ValueError("no channel has a bound, so that any two runs would pass")
        return self


def shipped_bounds() -> Path:
    """The file that comes with the package; its text says where each number is from."""
    return Path(str(resources.files("softloop.offline") / "data" / "parity.toml"))


def load_bounds(path: Path | None) -> ParityBounds:
    """Read and check a file of bounds, the shipped one without a path. Raises BadFile, BadConfig with one line."""
    file = path or shipped_bounds()
    if not file.is_file():
        raise BadFile(f"{file}: there is no such file of bounds; the shipped one is {shipped_bounds()}")
    return load_model(ParityBounds, read_toml(file), file)
