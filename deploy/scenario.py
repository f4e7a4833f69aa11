"""A scenario: what goes wrong in a run, when, and which safe outcome it must come to. One TOML file each."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any, Literal, get_args

import tomlkit
from pydantic import Field, ValidationError, model_validator

from softloop.deploy.bench import Bench, Source, find_bench, read_source, substituted, validate
from softloop.deploy.fault_times import check_times
from softloop.deploy.scenario_keys import Places, ScenarioKeys, places_of
from softloop.plant.config import FaultConfig
from softloop.wire.benchfile import Table, load_model, read_toml
from softloop.wire.errors import BadConfig, BadFile
from softloop.wire.fault_config import InjectionConfig, InjectionFields, Kind

PLANT_KINDS: tuple[str, ...] = get_args(FaultConfig.model_fields["kind"].annotation)
HOST_KINDS: tuple[str, ...] = get_args(Kind)
NAME = r"^[a-z0-9_-]{1,40}$"
# Key of the bench -> the scenario's own.
_OWN_KEYS = {"pace.mode": "pace", "run.duration_s": "duration_s", "faults.seed": "seed"}


class ScenarioInjection(InjectionFields):
    """One thing that goes wrong, on the host's side or in the simulated rig."""

    @property
    def in_plant(self) -> bool:
        """It breaks something in the simulated rig."""
        return self.kind in PLANT_KINDS

    @model_validator(mode="after")
    def _is_one(self) -> ScenarioInjection:
        if not self.in_plant and self.kind not in HOST_KINDS:
            raise ValueError(f"no kind '{self.kind}'; there are: {', '.join(PLANT_KINDS + HOST_KINDS)}")
        if self.in_plant and (self.target or self.probability != 1.0):
            raise ValueError(f"kind '{self.kind}' breaks the simulated rig and has neither target nor probability")
        try:
            FaultConfig.model_validate(self.plant_fault(0.0)) if self.in_plant else self.injection()
        except ValidationError as error:
            raise ValueError(error.errors()[0]["msg"].removeprefix("Value error, ")) from None
        return self

    def plant_fault(self, armed_s: float) -> dict[str, Any]:
        """The `[[plant.faults]]` for a gate that is armed `armed_s` after what the plant counts from."""
        on_s = armed_s + self.at_s
        return {"kind": self.kind, "on_s": on_s, "off_s": on_s + self.duration_s, "size": self.size}

    def injection(self) -> dict[str, Any]:
        """The `[[faults.injections]]`."""
        return InjectionConfig.model_validate(self.model_dump()).model_dump()


class Scenario(Table):
    """A scenario file."""

    name: str = Field(pattern=NAME, description="a-z, 0-9, _ and -")
    description: str = Field(min_length=1, description="what happens, in a line")
    seed: int = Field(1, ge=0, description="of what is left to chance")
    bench: str = Field("sim", description="a bench file beside this one, or the name of a shipped one")
    pace: Literal["wall", "lockstep"] = Field("wall", description="by the clock, or tick by tick and exact")
    duration_s: float = Field(gt=0, description="how long the rig is armed, unless a fault ends that")
    expected: Literal["VENT", "DEAD", "CONTINUE", "TRAPPED"] = Field(description="what it must come to; see docs/faults.md")
    overrides: dict[str, Any] = Field(default_factory=dict, description="tables of the bench file, put over the bench's")
    injections: tuple[ScenarioInjection, ...] = Field(min_length=1, max_length=16, description="each an [[injections]]")


def shipped_scenarios() -> dict[str, Path]:
    """Name -> file of the scenarios that come with the package."""
    folder = Path(str(resources.files("softloop.deploy") / "scenarios"))
    return {p.stem: p for p in sorted(folder.glob("*.toml"))}


def find_scenario(path: Path) -> Path:
    """The scenario file at `path`, or the shipped one of that name. Raises BadFile when there is neither."""
    if path.is_file():
        return path
    shipped = shipped_scenarios()
    if str(path) in shipped:
        return shipped[str(path)]
    raise BadFile(f"{path}: there is no such scenario file; shipped ones go by name: {', '.join(shipped)}")


def load_scenario(path: Path) -> Scenario:
    """Read and check a scenario file. Raises BadFile, BadConfig: one line with file, key, fault and what is allowed."""
    return load_model(Scenario, read_toml(path), path)


def bench_of(scenario: Scenario, path: Path) -> Path:
    """The bench file that a scenario names: beside it, or a shipped one. Raises BadFile."""
    try:
        beside = path.parent / scenario.bench
        return beside if beside.is_file() else find_bench(Path(scenario.bench))
    except BadFile as error:
        raise BadFile(f"{path}: key 'bench': {error}") from None
    except OSError as error:  # such as a name that is longer than any file's
        raise BadFile(f"{path}: key 'bench': cannot be looked for: {error.strerror or error}") from None


def write_bench(scenario: Scenario, path: Path, bench_file: Path, file: Path, changes: dict[str, Any] | None = None) -> None:
    """Write the bench of a scenario, as `make_bench` makes it, to `file`. Raises BadFile, BadConfig: one line."""
    file.write_text(tomlkit.dumps(make_bench(scenario, path, bench_file, changes)), encoding="utf-8")


def make_bench(scenario: Scenario, path: Path, bench_file: Path, changes: dict[str, Any] | None = None) -> dict[str, Any]:
    """The content of a scenario's bench: that of `bench_file`, the scenario's overrides and injections put in.

    Args:
        path: the scenario's file, to name in errors.
        changes: more tables, put over all others.

    Raises:
        BadFile, BadConfig: one line, which names a key of the scenario's file where that is wrong.
    """
    content, keys = read_source(bench_file).content, ScenarioKeys(path, bench_file, scenario.overrides)
    _put_over(content, substituted(scenario.overrides, path, None))
    with keys.named():
        bench = load_model(Bench, content, path)
    for over in (_own_tables(scenario), changes or {}):
        _put_over(content, over)
    keys.places |= {**_OWN_KEYS, **_inject(scenario, path, bench, content)}
    with keys.named():
        check_times(validate(Source(path, content)), path)
    return content


def _own_tables(scenario: Scenario) -> dict[str, Any]:
    return {"pace": {"mode": scenario.pace}, "run": {"duration_s": scenario.duration_s}}


def _inject(scenario: Scenario, path: Path, bench: Bench, content: dict[str, Any]) -> Places:
    """Put the injections where the plant, the other processes and the launcher find theirs; gives where that is."""
    host = {place: one.injection() for place, one in enumerate(scenario.injections) if not one.in_plant}
    before = [one.model_dump() for one in bench.faults.injections]
    content["faults"] = {"seed": scenario.seed, "injections": [*before, *host.values()]}
    places = places_of("faults.injections", len(before), host)
    exact = scenario.pace == "lockstep"
    armed_s = bench.run.settle_s if exact else 0.0
    plant = {place: one.plant_fault(armed_s) for place, one in enumerate(scenario.injections) if one.in_plant}
    if not plant:
        return places
    own = _faults_of(bench, exact, f"{path}: key 'injections.{min(plant)}'", plant[min(plant)]["kind"])
    content["plant"]["faults"] = [*own, *plant.values()]
    content["plant"]["faults_from"] = "start" if exact else "armed"
    return places | places_of("plant.faults", len(own), plant)


def _faults_of(bench: Bench, exact: bool, key: str, kind: str) -> list[dict[str, Any]]:
    """What the bench's own plant breaks. Raises BadConfig where none can be added to it."""
    if bench.plant is None:
        raise BadConfig(f"{key}: '{kind}' breaks the simulated rig, and this bench has none")
    if bench.plant.faults and not exact:
        raise BadConfig(f"{key}: this bench has [[plant.faults]] of its own, whose times count from elsewhere")
    return [one.model_dump() for one in bench.plant.faults]


def _put_over(content: dict[str, Any], over: dict[str, Any]) -> None:
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(content.get(key), dict):
            _put_over(content[key], value)
        else:
            content[key] = value
