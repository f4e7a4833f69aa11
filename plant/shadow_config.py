"""`[shadow]` of the bench file: a simulated plant that follows the rig live."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from softloop.plant.config import PlantConfig, SpecimenConfig


class ShadowConfig(SpecimenConfig):
    """`[shadow]`: a simulated plant that follows the rig on its valve currents, and says how far the two are apart."""

    currents: Literal["sent", "measured"] = Field(
        "sent",
        description="which drive it: as the gate sent them, or as measured; always measured while the driver vents by itself",
    )
    behind_ms: float = Field(30.0, ge=5, le=1000, description="it stays so far behind the clock, so that all has arrived")
    correction_s: float = Field(0.2, ge=0, le=100, description="so slowly its chamber follows the measured pressure; 0: never")
    correction_max_kpa_s: float = Field(100.0, gt=0, le=1000, description="and never faster than this")
    window_s: float = Field(1.0, gt=0, le=60, description="over which the root mean squares are taken")

    @property
    def plant(self) -> PlantConfig:
        """The specimen as the plant's kernels take it."""
        return PlantConfig(**{name: getattr(self, name) for name in SpecimenConfig.model_fields})


@dataclass(frozen=True)
class ShadowProcess:
    """What the process `shadow` is given. `valves_bitrate`: of the bus on which the valve frames travel."""

    table: ShadowConfig
    valves_bitrate: int


def shadow_process(table: ShadowConfig, valves_bitrate: int) -> ShadowProcess:
    """The config of `shadow` with what it must know of the wires."""
    return ShadowProcess(table, valves_bitrate)
