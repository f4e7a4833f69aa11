"""The bench file: all tables of a rig in one model, with errors that name the key, the file and what is allowed.

Three keys at the top make one bench out of another. `base = "sim.toml"` takes over the tables of that file (found beside this
one); what stands in this file replaces key by key what stands there. `without = ["plant"]` leaves out tables of the base.
`pieces = ["calibration.toml"]` takes over what stands in files of keys alone, such as `softloop calibrate` writes: over the
base, and under what stands in this file.
In every text value `{run_dir}` means the run directory, `{port}` a TCP port that follows from it, so that runs side by side
do not meet on one, and `{bench_dir}` the folder of the file the text stands in.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields
from importlib import resources
from pathlib import Path
from typing import Any
from zlib import crc32

from pydantic import Field, ValidationError

from softloop.controller.config import ControllerConfig
from softloop.deploy.config import CalibrationConfig, MachineConfig, RunConfig
from softloop.deploy.hosts import check_hosts
from softloop.devices.config import InclinometerConfig, PressuresConfig, ValvesConfig, bus_of, pressures_process, valves_process
from softloop.plant.config import PlantConfig, emulated_buses, plant_process
from softloop.plant.shadow_config import ShadowConfig, shadow_process
from softloop.watch.config import FoxgloveConfig, LawGains, MonitorConfig, MonitorProcess, PageConfig, RecorderConfig
from softloop.wire.benchfile import Table, load_model, read_toml, validated
from softloop.wire.can_config import CanConfig
from softloop.wire.clock_config import ClockConfig
from softloop.wire.config import HostConfig, PaceConfig, ZenohConfig
from softloop.wire.errors import BadConfig, BadFile
from softloop.wire.fault_config import FaultsConfig

NAME = r"^[a-z0-9_-]{1,24}$"
MAX_BASES = 8
FIRST_PORT, PORTS = 20_000, 12_000
# In the order in which they are started; any order works.
PROCESS_NAMES = ("recorder", "monitor", "shadow", "plant", "valves", "pressures", "inclinometer", "controller")

Key = tuple[str, ...]


class Bench(Table):
    """A whole bench. A process runs when its table stands in the file."""

    name: str = Field(pattern=NAME, description="part of every Zenoh key: a-z, 0-9, _ and -, at most 24")
    zenoh: ZenohConfig = ZenohConfig()
    host: HostConfig = HostConfig()
    hosts: dict[str, MachineConfig] = Field(default_factory=dict)
    clock: ClockConfig = ClockConfig()
    pace: PaceConfig = PaceConfig()
    run: RunConfig = RunConfig()
    can: dict[str, CanConfig] = Field(default_factory=dict)
    plant: PlantConfig | None = None
    valves: ValvesConfig | None = None
    pressures: PressuresConfig | None = None
    inclinometer: InclinometerConfig | None = None
    controller: ControllerConfig | None = None
    recorder: RecorderConfig | None = None
    monitor: MonitorConfig | None = None
    shadow: ShadowConfig | None = None
    page: PageConfig = PageConfig()
    foxglove: FoxgloveConfig = FoxgloveConfig()
    faults: FaultsConfig = FaultsConfig()
    calibration: CalibrationConfig | None = None


@dataclass(frozen=True)
class Source:
    """The merged content of a bench file and its bases, and which file each key came from."""

    file: Path
    content: dict[str, Any]
    origins: dict[Key, Path] = field(default_factory=dict)
    run_dir: Path | None = None

    def origin(self, where: Key) -> Path:
        """The file in which a key, or the nearest table around it, stands."""
        for length in range(len(where), 0, -1):
            if where[:length] in self.origins:
                return self.origins[where[:length]]
        return self.file


def shipped_benches() -> dict[str, Path]:
    """Name -> file of the benches that come with the package."""
    folder = Path(str(resources.files("softloop.deploy") / "benches"))
    return {p.stem: p for p in sorted(folder.glob("*.toml"))}


def find_bench(path: Path) -> Path:
    """The bench file at `path`, or the shipped one of that name. Raises BadFile when there is neither."""
    if path.is_file():
        return path
    shipped = shipped_benches()
    if str(path) in shipped:
        return shipped[str(path)]
    raise BadFile(f"{path}: there is no such bench file; shipped ones go by name: {', '.join(shipped)}")


def read_source(path: Path, run_dir: Path | None = None) -> Source:
    """Read a bench file with its bases, texts substituted. Raises BadFile or BadConfig with one line."""
    content: dict[str, Any] = {}
    origins: dict[Key, Path] = {}
    for file, own in reversed(_chain(path)):
        for name in own.pop("without", []):
            _remove(content, origins, name, file)
        own.pop("base", None)
        for piece, keys in _pieces_of(file, own.pop("pieces", [])):
            _merge(content, origins, substituted(keys, piece, run_dir), piece, ())
        _merge(content, origins, substituted(own, file, run_dir), file, ())
    return Source(path, content, origins, run_dir)


def folders_of(path: Path) -> tuple[str, ...]:
    """What `{bench_dir}` becomes in a bench file and its bases."""
    return tuple(str(file.parent.resolve()) for file, _ in _chain(path))


def load_bench(path: Path, run_dir: Path | None = None) -> Bench:
    """Read and check a bench.

    Args:
        path: the file.
        run_dir: what `{run_dir}` and `{port}` become; without it they stay as they are (enough to check a file).

    Raises:
        BadFile, BadConfig: one line with file, key, fault and what is allowed.
    """
    return validate(read_source(path, run_dir))


def validate(source: Source) -> Bench:
    """The bench in `source`. Raises BadConfig as `load_bench` does."""
    try:
        bench = validated(Bench, source.content)
    except ValidationError as error:
        where = tuple(str(part) for part in error.errors()[0]["loc"])
        return load_model(Bench, source.content, source.origin(where))  # says it in one line
    _check_together(bench, source)
    if source.run_dir is None:
        return bench
    # Default values may name the run directory too.
    return Bench.model_validate(substituted(bench.model_dump(), source.file, source.run_dir))


def process_config(bench: Bench, name: str) -> Any:
    """What the `run` of process `name` is given. Raises BadConfig when its table does not agree with the others."""
    table = getattr(bench, name)
    if name == "plant":
        return plant_process(table, bench.can)
    if name == "pressures":
        return pressures_process(table, bench.can)
    if name == "valves":
        if bench.pressures is None or bench.inclinometer is None:
            raise BadConfig("key 'valves': the gate needs the tables [pressures] and [inclinometer] too")
        return valves_process(table, bench.pressures, bench.inclinometer, bench.can)
    if name == "shadow":
        if bench.valves is None:
            raise BadConfig("key 'shadow': the shadow follows the valve currents and needs the table [valves] too")
        return shadow_process(table, bus_of(bench.can, "valves", bench.valves.can).bitrate)
    if name == "monitor":
        if bench.controller is None:
            raise BadConfig("key 'monitor': the monitor needs the table [controller] too")
        return monitor_process(table, bench.controller)
    return table


def monitor_process(table: MonitorConfig, controller: ControllerConfig) -> MonitorProcess:
    """What the monitor is given of the controller's table."""
    gains = {"arc": controller.arc, "smc": controller.smc}.get(controller.law)
    law = None if gains is None else LawGains(**{f.name: getattr(gains, f.name) for f in fields(LawGains)})
    return MonitorProcess(table, controller.parameters, law, controller.law not in ("pressure", "pressure_eso", "valve_test"))


def _check_together(bench: Bench, source: Source) -> None:
    """Tables that each are right must also agree, such as on the names of CAN buses."""
    for name in PROCESS_NAMES:
        if getattr(bench, name) is None:
            continue
        try:
            process_config(bench, name)
        except BadConfig as error:
            key = re.search(r"key '([^']+)'", str(error))
            where = tuple(key[1].split(".")) if key else (name,)
            raise BadConfig(f"{source.origin(where)}: {error}") from None
    if bench.pace.mode == "lockstep":
        check_lockstep(bench, source.file)
    _check_buses(bench, source)
    _check_router(bench, source)
    try:
        check_hosts(bench)
    except BadConfig as error:
        raise BadConfig(f"{source.file}: {error}") from None


def _check_buses(bench: Bench, source: Source) -> None:
    """An emulated bus is held by the plant, so it must be on it. Raises BadConfig."""
    emulated = emulated_buses(bench.plant, bench.can) if bench.plant is not None else ()
    for name in sorted({name for name, bus in bench.can.items() if bus.emulation is not None} - {*emulated}):
        where = f"{source.origin(('can', name, 'emulation'))}: key 'can.{name}.emulation'"
        raise BadConfig(f"{where}: the simulated rig holds an emulated bus, so [plant] must be on [can.{name}]")
    if emulated and bench.zenoh.tls is not None:
        raise BadConfig(
            f"{source.file}: key 'can': on a secured bench the gate alone may put valve frames on the wire, so a bus "
            "that the simulated rig holds cannot carry them; leave out [can.NAME.emulation]"
        )
    names = (getattr(bench.plant, "can_analog", ""), getattr(bench.plant, "can_valves", ""))
    for place, injection in enumerate(bench.faults.injections):
        if injection.family == "bus" and names[injection.target != "analog"] not in emulated:
            raise BadConfig(f"{_of_injection(source, place)}: kind '{injection.kind}' needs a [can.NAME.emulation]")


def _of_injection(source: Source, place: int) -> str:
    """How an error begins that is about one of the bench's injections."""
    return f"{source.origin(('faults', 'injections'))}: key 'faults.injections.{place}'"


def _check_router(bench: Bench, source: Source) -> None:
    """A meeting point that is to be lost is neither the launcher nor another host's affair. Raises BadConfig."""
    lost = next((place for place, injection in enumerate(bench.faults.injections) if injection.family == "router"), None)
    if lost is not None and (not bench.run.shared_router or bench.hosts):
        raise BadConfig(
            f"{_of_injection(source, lost)}: kind 'router_loss' needs [run] shared_router = true, on one host; the run "
            "then starts its router itself"
        )


def check_lockstep(bench: Bench, file: Path, pace: str = "lockstep", asked: str = "key 'pace.mode'") -> None:
    """What waits for real time cannot be in a run that stands still while it waits, nor in one of one process. Raises BadConfig.

    Args:
        pace: lockstep, or batch, which is lockstep in one process.
        asked: where that pace was asked for.
    """
    if bench.plant is None or bench.valves is None or bench.controller is None:
        raise BadConfig(
            f"{file}: {asked}: {pace} needs the tables [plant], [valves] and [controller]: real devices do not wait for a tick"
        )
    if bench.valves.driver != "rig":
        raise BadConfig(f"{file}: key 'valves.driver': must be \"rig\" at {pace} pace, as the simulated driver is one")
    if bench.plant.faults_from != "start":
        raise BadConfig(f"{file}: key 'plant.faults_from': must be \"start\" at {pace} pace, where arming is planned")
    for place, injection in enumerate(bench.faults.injections):
        if injection.needs_wall:
            raise BadConfig(f"{file}: key 'faults.injections.{place}': kind '{injection.kind}' needs wall pace")
    talking = next((name for name, bus in bench.can.items() if bus.emulation is not None and bus.emulation.bus_errors), None)
    if talking is not None:
        raise BadConfig(f"{file}: key 'can.{talking}.emulation.bus_errors': must be false at {pace} pace")
    if bench.inclinometer is not None and bench.inclinometer.configure:
        raise BadConfig(f"{file}: key 'inclinometer.configure': must be false at {pace} pace")


def _chain(path: Path) -> list[tuple[Path, dict[str, Any]]]:
    """The file and its bases, each with its content, the file itself first."""
    chain: list[tuple[Path, dict[str, Any]]] = []
    file: Path | None = path
    while file is not None:
        if len(chain) == MAX_BASES:
            raise BadConfig(f"{path}: key 'base': more than {MAX_BASES} files deep; does a file name itself as its base?")
        own = read_toml(file)
        _check_head(file, own)
        chain.append((file, own))
        file = _base_of(file, own)
    return chain


def _check_head(file: Path, own: dict[str, Any]) -> None:
    if not isinstance(own.get("base", ""), str):
        raise BadConfig(f"{file}: key 'base': must be the name of a bench file in quotes (got {own['base']!r})")
    without = own.get("without", [])
    if not isinstance(without, list) or not all(isinstance(name, str) for name in without):
        raise BadConfig(f"{file}: key 'without': must be a list of table names in quotes (got {without!r})")


def _pieces_of(file: Path, names: Any) -> list[tuple[Path, dict[str, Any]]]:
    """The pieces that a file names, each with its content. Raises BadFile, BadConfig."""
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise BadConfig(f"{file}: key 'pieces': must be a list of file names in quotes (got {names!r})")
    found = []
    for name in names:
        piece = file.parent / name
        if not piece.is_file():
            raise BadFile(f"{file}: key 'pieces': there is no file {piece}")
        keys = read_toml(piece)
        head = sorted({"base", "without", "pieces"} & set(keys))
        if head:
            raise BadConfig(f"{piece}: key '{head[0]}': a piece has none")
        found.append((piece, keys))
    return found


def _base_of(file: Path, own: dict[str, Any]) -> Path | None:
    if "base" not in own:
        return None
    base = file.parent / own["base"]
    if not base.is_file():
        raise BadFile(f"{file}: key 'base': there is no file {base}")
    return base


def _remove(content: dict[str, Any], origins: dict[Key, Path], name: str, file: Path) -> None:
    *outer, last = name.split(".")
    table: Any = content
    for part in outer:
        table = table.get(part, {}) if isinstance(table, dict) else {}
    if not isinstance(table, dict) or last not in table:
        raise BadConfig(f"{file}: key 'without': the base has no '{name}'; it has: {', '.join(sorted(content)) or 'nothing'}")
    del table[last]
    gone = (*outer, last)
    for key in [k for k in origins if k[: len(gone)] == gone]:
        del origins[key]


def _merge(content: dict[str, Any], origins: dict[Key, Path], own: dict[str, Any], file: Path, where: Key) -> None:
    """Put `own` over `content`, table by table and key by key, and note which file each key is from."""
    for key, value in own.items():
        here = (*where, key)
        origins[here] = file
        if isinstance(value, dict) and isinstance(content.get(key), dict):
            _merge(content[key], origins, value, file, here)
        elif isinstance(value, dict):
            content[key] = {}
            _merge(content[key], origins, value, file, here)
        else:
            content[key] = value


def substituted(value: Any, file: Path, run_dir: Path | None) -> Any:
    """A copy of what stands in `file` with `{bench_dir}` filled in, and with a run's directory what follows from that."""
    if isinstance(value, dict):
        return {key: substituted(inner, file, run_dir) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [substituted(inner, file, run_dir) for inner in value]
    if not isinstance(value, str):
        return value
    value = value.replace("{bench_dir}", str(file.parent.resolve()))
    if run_dir is None:
        return value
    return value.replace("{run_dir}", str(run_dir.resolve())).replace("{port}", str(port_of(run_dir)))


def port_of(run_dir: Path) -> int:
    """The TCP port of a run: below those that Linux gives out by itself (32768 and above), the same for all its processes."""
    return FIRST_PORT + crc32(str(run_dir.resolve()).encode()) % PORTS
