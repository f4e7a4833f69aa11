"""`softloop experiment`: runs of a bench with another law and trajectory, one after the other, each as `softloop run` does it.

What an experiment changes stands in a small bench file of its own in the experiment's folder, with the bench as its base: so
addresses, limits of the gate and all else are the bench's, simulated or real, and each run can be run again by its file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import gmtime, strftime
from typing import Any, Literal

import tomlkit

from softloop.controller.config import ControllerConfig
from softloop.deploy.bench import Bench, check_lockstep, load_bench
from softloop.deploy.run_dir import BENCH_FILE
from softloop.wire.benchfile import read_toml
from softloop.wire.errors import EXIT_OK, BadConfig, Unavailable

Pace = Literal["wall", "lockstep", "batch"]

# Keys of [controller] that say what a rig is like, and not how a law is tuned.
OF_THE_RIG = (
    "actuation_delay_ms", "pressure_delay_ms", "inclination_delay_ms", "pressure_budget_ms", "inclination_budget_ms",
)  # fmt: skip


@dataclass(frozen=True)
class Asked:
    """What the command line asks of an experiment.

    Attributes:
        bench: the bench file.
        out: the experiment's folder; None: `<folder>/<bench>-<experiment>-<UTC time>`.
        pace: None: the bench file's; "batch": in this process, on a whole simulated rig.
        parameters: instead of the bench's own, for the laws.
        seed: of the multi-sines; None: the bench's.
        quiet: no live view and no tables of the runs.
        report: a report for each run; None: as the bench has it.
    """

    bench: Path
    out: Path | None = None
    pace: Pace | None = None
    parameters: str | None = None
    seed: int | None = None
    quiet: bool = False
    report: bool | None = None


@dataclass(frozen=True)
class Place:
    """An experiment's folder, and what its runs have in common."""

    folder: Path
    asked: Asked
    bench: Bench

    def run_dir(self, name: str) -> Path:
        return self.folder / name


def begin(asked: Asked, kind: str) -> Place:
    """The folder of an experiment, made now. Raises BadFile, BadConfig or Unavailable."""
    bench = load_bench(asked.bench)
    for table in ("valves", "controller", "recorder"):
        if getattr(bench, table) is None:
            raise BadConfig(f"{asked.bench}: an experiment needs the table [{table}]")
    if asked.pace in ("lockstep", "batch"):
        check_lockstep(bench, asked.bench, asked.pace, f"--pace {asked.pace}")
    folder = asked.out or Path(bench.run.folder) / f"{bench.name}-{kind}-{strftime('%Y%m%dT%H%M%SZ', gmtime())}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Unavailable(f"{folder}: cannot be made: {error.strerror or error}") from None
    return Place(folder, asked, bench)


def check_free(place: Place, names: Iterable[str]) -> None:
    """None of an experiment's runs is in its folder yet. Raises Unavailable, before the first one."""
    for name in names:
        if (place.run_dir(name) / BENCH_FILE).exists():
            raise Unavailable(f"{place.folder}: holds the run '{name}' already; name another folder with --out")


def run_one(place: Place, name: str, changes: Mapping[str, Any]) -> int:
    """One run of the experiment, in `<folder>/<name>`; returns its exit code. Raises as `softloop run` does.

    Args:
        name: of the run's directory.
        changes: tables of the bench file, as they differ from the bench's.
    """
    file = bench_file(place, name, changes)
    target, quiet, report = place.run_dir(name), place.asked.quiet, place.asked.report
    if place.asked.pace == "batch":
        from softloop.deploy.batch_run import run_here  # noqa: PLC0415 - it brings the kernels into this process

        return run_here(file, target, report=place.bench.run.report if report is None else report, quiet=quiet)
    from softloop.deploy.launcher import Options, launch  # noqa: PLC0415 - likewise Zenoh

    return launch(file, Options(run_dir=target, quiet=quiet, pace=place.asked.pace, report=report))


def gains_of(law: str, own: ControllerConfig | None) -> dict[str, Any]:
    """The [controller] table of a law's tuned gains, empty where it has none; what a bench's `own` states of its rig stays."""
    from softloop.offline.evaluation import tuned_file  # noqa: PLC0415 - it brings the kernels

    file = tuned_file(law)
    gains = read_toml(file)["controller"] if file.is_file() else {}
    stated = own.model_fields_set if own else set()
    return {key: value for key, value in gains.items() if key not in OF_THE_RIG or key not in stated}


def bench_file(place: Place, name: str, changes: Mapping[str, Any]) -> Path:
    """Write the bench file of one run, and check it. Raises BadConfig."""
    controller: dict[str, Any] = dict(changes.get("controller", {}))
    if place.asked.parameters is not None:
        controller["parameters"] = place.asked.parameters
    if place.asked.seed is not None:
        controller["trajectory_seed"] = place.asked.seed
    content = {"base": str(place.asked.bench.resolve()), "name": place.bench.name, **changes, "controller": controller}
    file = place.folder / f"{name}.toml"
    try:
        file.write_text(tomlkit.dumps(content), encoding="utf-8")
    except OSError as error:
        raise Unavailable(f"{file}: cannot be written: {error.strerror or error}") from None
    load_bench(file)
    return file


def run_all(place: Place, runs: Mapping[str, Mapping[str, Any]]) -> int:
    """The runs one after the other; the first exit code that is not EXIT_OK, and none is started after it."""
    check_free(place, runs)
    for name, changes in runs.items():
        code = run_one(place, name, changes)
        if code != EXIT_OK:
            return code
    return EXIT_OK
