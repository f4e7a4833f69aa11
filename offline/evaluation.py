"""`softloop evaluate`: every law, tuned alike, on rigs that none was tuned on, at the rig's own latency and under what is harder.

Gains come from the tuned files that are shipped (`controller/data/tuned`), one per law and latency, and are the same for every
rig and trajectory. A law is judged on each rig by T1, T2 and T1 with a payload that comes and goes, against the true angle.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from softloop.controller.config import ControllerConfig
from softloop.controller.setup import build
from softloop.offline.trials import Trial, lead_s, run_trial
from softloop.offline.tuning import BARS_DEG, SWITCHES_PER_S, Latency, start_config
from softloop.plant.config import FaultConfig, PlantConfig
from softloop.wire.benchfile import load_model, read_toml

Progress = Callable[[int, int], None]  # rigs done, rigs in all

LAWS = ("pid", "pid_eso", "smc", "arc", "arc_eso")
PAPER_DEG = {"t1": 4.36, "steady": 0.82, "t2": 3.67}  # the paper's measured figures of ARC
RECOVERY_S = 1.0
SUPPLY_DROP_AT_S, SUPPLY_LEFT = 10.0, 0.85  # of the trajectory; part of the supply pressure that stays
COLD_C = 0.0  # the rigs are drawn between 10 and 40 C


@dataclass(frozen=True)
class Condition:
    """What is harder than the rig as it is."""

    name: str
    added_ms: float = 0.0
    noise: float = 1.0  # times the sensors' own
    supply_loss: float = 0.0  # part of the supply that is lost from SUPPLY_DROP_AT_S on
    ambient_c: float | None = None

    def plant(self, seed: int, controller: ControllerConfig) -> PlantConfig:
        """The rig of a seed under this condition."""
        sheet = PlantConfig(seed=seed, ambient_c=self.ambient_c)
        noise = {n: self.noise * getattr(sheet, n) for n in ("pressure_noise_kpa", "angle_noise_deg", "rate_noise_deg_s")}
        faults: tuple[FaultConfig, ...] = ()
        if self.supply_loss:
            faults = (FaultConfig(kind="supply_loss", on_s=lead_s(controller) + SUPPLY_DROP_AT_S, size=self.supply_loss),)
        return Latency(self.added_ms).plant(sheet.model_copy(update={**noise, "faults": faults}))


OWN = Condition("own latency")
CONDITIONS = (
    OWN,
    Condition("+20 ms", added_ms=20.0),
    Condition("+40 ms", added_ms=40.0),
    Condition("+100 ms", added_ms=100.0),
    Condition("noise doubled", noise=2.0),
    Condition("supply -15 %", supply_loss=1.0 - SUPPLY_LEFT),
    Condition("0 C", ambient_c=COLD_C),
)


def tuned_file(law: str, added_ms: float = 0.0) -> Path:
    """Where the gains of a law at a latency stand; the file may not exist."""
    suffix = f"_{added_ms:g}ms" if added_ms else ""
    return Path(str(resources.files("softloop.controller") / "data" / "tuned" / f"{law}{suffix}.toml"))


def tuned(law: str, added_ms: float = 0.0) -> tuple[ControllerConfig, float | None]:
    """The tuned [controller] of a law, and the added latency that it was tuned at; None: not tuned, the gains are defaults.

    Where a latency has no gains of its own, those of the rig's own latency, told of the added delay. Raises BadFile or BadConfig.
    """
    path, at_ms = tuned_file(law, added_ms), added_ms
    if not path.is_file():
        path, at_ms = tuned_file(law), 0.0
    if not path.is_file():
        return Latency(added_ms).controller(start_config(law)), None
    found = load_model(ControllerConfig, read_toml(path)["controller"], path)
    return Latency(added_ms - at_ms).controller(found), at_ms


@dataclass(frozen=True)
class Judged:
    """One law on one rig."""

    seed: int
    t1: Trial
    t2: Trial
    payload: Trial

    @property
    def bars_kept(self) -> bool:
        """T1, T2 and steady error within our bars."""
        return (
            self.t1.max_deg <= BARS_DEG["t1"] and self.t1.steady_deg <= BARS_DEG["steady"] and self.t2.max_deg <= BARS_DEG["t2"]
        )

    @property
    def paper_kept(self) -> bool:
        """The paper's three figures are kept."""
        found = (self.t1.max_deg, self.t1.steady_deg, self.t2.max_deg)
        return all(f <= bound for f, bound in zip(found, PAPER_DEG.values(), strict=True))

    @property
    def payload_kept(self) -> bool:
        """The payload's arrival stays under its peak, and is over in time."""
        return self.payload.peak_deg <= BARS_DEG["peak"] and self.payload.recovery_s <= RECOVERY_S

    @property
    def quiet(self) -> bool:
        """The valves switch no more than allowed on dwells."""
        return self.t1.switches_per_s <= SWITCHES_PER_S


def judge_law(
    controller: ControllerConfig, condition: Condition, seeds: Sequence[int], progress: Callable[[], None] | None = None
) -> list[Judged]:
    """A law with its gains on every rig. Raises BadFile or BadConfig."""
    one, two = (controller.model_copy(update={"trajectory": name}) for name in ("t1", "t2"))
    build(one)  # a fault of the file shows before the first rig
    found = []
    for seed in seeds:
        plant = condition.plant(seed, controller)
        found.append(Judged(seed, run_trial(one, plant), run_trial(two, plant), run_trial(one, plant, payload=True)))
        if progress is not None:
            progress()
    return found


def figures(judged: Sequence[Judged]) -> dict[str, Any]:
    """Worst and median of each figure, and on how many rigs each bar is kept."""
    columns = {
        "t1_max_deg": [j.t1.max_deg for j in judged],
        "t1_steady_deg": [j.t1.steady_deg for j in judged],
        "t2_max_deg": [j.t2.max_deg for j in judged],
        "t2_rms_deg": [j.t2.rms_deg for j in judged],
        "payload_peak_deg": [j.payload.peak_deg for j in judged],
        "payload_recovery_s": [j.payload.recovery_s for j in judged],
        "left_peak_deg": [j.payload.left_peak_deg for j in judged],
        "left_recovery_s": [j.payload.left_recovery_s for j in judged],
        "dwell_switches_per_s": [j.t1.switches_per_s for j in judged],
        "t2_switches_per_s": [j.t2.switches_per_s for j in judged],
        "t1_effort_ma_s": [j.t1.effort_ma_s for j in judged],
        "t2_effort_ma_s": [j.t2.effort_ma_s for j in judged],
    }
    found: dict[str, Any] = {"rigs": len(judged)}
    for name, values in columns.items():
        found[name] = {"worst": float(np.max(values)), "median": float(np.median(values))}
    for name in ("bars_kept", "payload_kept", "paper_kept", "quiet"):
        found[name] = sum(getattr(j, name) for j in judged)
    return found


@dataclass(frozen=True)
class Verdict:
    """One law under one condition."""

    law: str
    condition: str
    tuned_at_ms: float | None
    judged: list[Judged]

    def content(self) -> dict[str, Any]:
        """What `--json` prints: the figures, and every rig."""
        rigs = [asdict(j) for j in self.judged]
        return {
            "law": self.law,
            "condition": self.condition,
            "tuned_at_ms": self.tuned_at_ms,
            **figures(self.judged),
            "by_rig": rigs,
        }


def evaluate(
    laws: Sequence[str], conditions: Sequence[Condition], seeds: Sequence[int], progress: Progress | None = None
) -> list[Verdict]:
    """Every law under every condition, with its gains for the condition's latency. Raises BadFile or BadConfig."""
    jobs = [(condition, law, *tuned(law, condition.added_ms)) for condition in conditions for law in laws]
    done, verdicts = 0, []

    def one_more() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done, len(jobs) * len(seeds))

    for condition, law, controller, at_ms in jobs:
        verdicts.append(Verdict(law, condition.name, at_ms, judge_law(controller, condition, seeds, one_more)))
    return verdicts
