"""`softloop reproduce`: every experiment, every identification and every comparison, and one page with the paper's beside ours.

The experiments leave logs. What is counted over many rigs (coverage, fits over seeds, the evaluation of laws) runs in one process
without logs; its rows say which seeds. Coverage, the longest, is a process of its own beside all else.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import gmtime, strftime
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from softloop.deploy import reproduce_sections as sections
from softloop.deploy.bench import find_bench
from softloop.deploy.evidence import write_evidence
from softloop.deploy.experiment import Asked, Pace
from softloop.deploy.experiment_pressure import RESULT as PRESSURE
from softloop.deploy.experiment_pressure import run_pressure
from softloop.deploy.experiment_tracking import RESULT as TRACKING
from softloop.deploy.experiment_tracking import run_tracking
from softloop.deploy.experiment_valves import RESULT as VALVES
from softloop.deploy.experiment_valves import SUPPLIES_KPA, run_name, run_valves
from softloop.deploy.tally import go_over
from softloop.deploy.tune import seeds_of
from softloop.offline.evaluation import LAWS, OWN, evaluate, figures
from softloop.offline.identification.experiments import FAST
from softloop.offline.identification.intervals import of_fit
from softloop.offline.reproduction import SLOW, FitTally, Identified, data_of, identify_all
from softloop.offline.reproduction_page import Section, page_of
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK, BadConfig, SoftloopError, Unavailable

PAGE, NUMBERS, COVERAGE = "reproduce.html", "reproduce.json", "coverage.json"
TRACKED = ("pid", "smc", "arc", "arc_eso")
RIG, TANK, OTHER = "sim", "sim_tank", "sim_firm"


@dataclass(frozen=True)
class Wanted:
    """What the command line asks for.

    Attributes:
        out: the folder; it must not hold a reproduction yet.
        pace: of the experiments with logs.
        rigs: ideal rigs whose intervals are counted.
        seeds: rigs over which fits and laws are judged.
    """

    out: Path | None
    pace: Pace
    rigs: int
    seeds: str
    quiet: bool


@dataclass
class Work:
    """A reproduction under way."""

    folder: Path
    wanted: Wanted
    say: Callable[[str, int, int], None]
    numbers: dict[str, Any] = field(default_factory=dict)
    sections: list[Section] = field(default_factory=list)

    def asked(self, bench: str, name: str, parameters: Path | None = None) -> Asked:
        """An experiment in the folder `name`."""
        chosen = None if parameters is None else str(parameters)
        return Asked(find_bench(Path(bench)), self.folder / name, self.wanted.pace, chosen, quiet=True, report=False)

    def counting(self, what: str) -> Callable[[int, int], None]:
        return lambda done, total: self.say(what, done, total)


def run_reproduce(wanted: Wanted) -> int:
    """Do all of it; returns EXIT_OK once the page is written, whatever the numbers on it say.

    Raises:
        BadConfig, Unavailable: before anything runs. SoftloopError: an experiment could not be run.
    """
    seeds_of(wanted.seeds)
    folder = _folder(wanted)
    began = time.monotonic()
    with _progress(quiet=wanted.quiet) as say, _coverage(folder, wanted.rigs) as covered:
        work = Work(folder, wanted, say)
        for step in STEPS:
            step(work)
        sections.add_coverage(work.sections, work.numbers, _waited(covered, folder, say))
    seconds = time.monotonic() - began
    _write(work, seconds)
    if not wanted.quiet:
        Console(highlight=False).print(f"page: {folder / PAGE}\n{seconds / 60.0:.1f} minutes", soft_wrap=True)
    return EXIT_OK


def _folder(wanted: Wanted) -> Path:
    folder = wanted.out or Path("runs") / f"reproduce-{strftime('%Y%m%dT%H%M%SZ', gmtime())}"
    if folder.exists() and not folder.is_dir():
        raise Unavailable(f"{folder}: is a file, and a folder is made there; name another with --out")
    if folder.exists() and any(folder.iterdir()):
        raise Unavailable(f"{folder}: is not empty; name another with --out")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Unavailable(f"{folder}: cannot be made: {error.strerror or error}") from None
    return folder.resolve()


def experiment(code: int, result: Path) -> None:
    """One that missed its bar is a number on the page; one that did not come to its end ends all. Raises SoftloopError."""
    if code not in (EXIT_OK, EXIT_NEGATIVE) or not result.is_file():
        error = SoftloopError(f"the experiment in {result.parent} ended with exit code {code}; nothing is reproduced from it")
        error.exit_code = code or EXIT_NEGATIVE
        raise error


def pressure(work: Work) -> None:
    """Data1 to Data3."""
    work.say("pressure experiment", 0, 1)
    experiment(run_pressure(work.asked(RIG, "pressure"), "pressure_eso"), work.folder / "pressure" / PRESSURE)
    sections.add_pressure(work.sections, work.numbers, work.folder, work.folder / "pressure")


def identification(work: Work) -> None:
    """Table 1, Figs. 2c and 2d, orders, and past the paper."""
    found = _identified(work, "pressure", "identified.toml", "identifying")
    sections.add_identification(work.sections, work.numbers, work.folder, found, work.counting("orders"))


def _identified(work: Work, name: str, output: str, what: str, only: str = "") -> Identified:
    fast, slow = (work.folder / name / run for run in (FAST, SLOW))
    series = data_of(fast, slow)
    found = identify_all(series, work.counting(what), only)
    fit = found.model("oe").fit
    write_evidence(work.folder / output, [fast, slow], fit, of_fit(fit, [series[0]], "coloured"), list(series))
    return found


def over_seeds(work: Work) -> None:
    """Fits on the rig layer over many rigs."""
    tally = FitTally()
    go_over(tally, seeds_of(work.wanted.seeds), work.counting("fitting rigs"))
    sections.add_seeds(work.sections, work.numbers, tally.counted(), work.wanted.seeds)


def valves(work: Work) -> None:
    """Fig. 4 and k_v1 to k_v6."""
    work.say("flow tests of the valves", 0, 1)
    experiment(run_valves(work.asked(TANK, "valves"), SUPPLIES_KPA, ratios=False), work.folder / "valves" / VALVES)
    logs = [work.folder / "valves" / run_name(s) for s in SUPPLIES_KPA]
    sections.add_valves(work.sections, work.numbers, work.folder, work.folder / "valves", logs)


def tracking(work: Work) -> None:
    """Figs. 6 and 7."""
    work.say("tracking", 0, 1)
    experiment(run_tracking(work.asked(RIG, "tracking"), TRACKED, own_gains=False), work.folder / "tracking" / TRACKING)
    sections.add_tracking(work.sections, work.numbers, work.folder, work.folder / "tracking")


def another_rig(work: Work) -> None:
    """A rig that is not the paper's: tracking on Table 1, and on what was identified from its own logs."""
    work.say("another rig", 0, 3)
    experiment(run_pressure(work.asked(OTHER, "other_pressure"), "pressure_eso"), work.folder / "other_pressure" / PRESSURE)
    _identified(work, "other_pressure", "other_identified.toml", "identifying another rig", only="oe")
    for done, (name, parameters) in enumerate((("other_table1", None), ("other_own", work.folder / "other_identified.toml"))):
        work.say("another rig", done + 1, 3)
        experiment(run_tracking(work.asked(OTHER, name, parameters), TRACKED, own_gains=False), work.folder / name / TRACKING)
    sections.add_other(work.sections, work.numbers, work.folder)


def evaluation(work: Work) -> None:
    """Every law on many rigs."""
    verdicts = evaluate(LAWS, [OWN], seeds_of(work.wanted.seeds), work.counting("evaluating laws"))
    sections.add_evaluation(work.sections, work.numbers, {v.law: figures(v.judged) for v in verdicts}, work.wanted.seeds)


STEPS: tuple[Callable[[Work], None], ...] = (
    pressure, identification, valves, tracking, another_rig, over_seeds, evaluation,
)  # fmt: skip


@contextmanager
def _progress(*, quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """A function `say(what, done, total)`: a bar on a terminal, else a line when something new begins."""
    if quiet:
        yield lambda what, done, total: None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    console = Console(stderr=True, highlight=False)
    with Progress(*columns, console=console, disable=not sys.stderr.isatty()) as bar:
        tasks: dict[str, Any] = {}

        def say(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bar.add_task(what, total=total)
                if not sys.stderr.isatty():
                    console.print(what)
            bar.update(tasks[what], completed=done, total=total)

        yield say


@contextmanager
def _coverage(folder: Path, rigs: int) -> Iterator[subprocess.Popen[bytes] | None]:
    """`softloop coverage` beside all else; ended with its parent's block."""
    if rigs == 0:
        yield None
        return
    words = ["coverage", "--rigs", str(rigs), "--layer", "ideal", "--output", str(folder / COVERAGE), "--json"]
    with (folder / "coverage.log").open("wb") as log:
        # Small matrices only: a second thread of the linear algebra would wait, and burn the core that the rest works on.
        alone = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "softloop.deploy.cli", *words]
        child = subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL, env=alone)
        try:
            yield child
        finally:
            if child.poll() is None:
                child.terminate()
            child.wait()


def _waited(child: subprocess.Popen[bytes] | None, folder: Path, say: Callable[[str, int, int], None]) -> Path | None:
    if child is None:
        return None
    say("waiting for coverage", 0, 1)
    code = child.wait()
    if code != EXIT_OK:
        raise BadConfig(f"coverage ended with exit code {code}; see coverage.log in the folder")
    say("waiting for coverage", 1, 1)
    return folder / COVERAGE


def _write(work: Work, seconds: float) -> None:
    numbers = work.numbers | {"seconds": seconds, "pace": work.wanted.pace}
    (work.folder / NUMBERS).write_text(json.dumps(numbers, indent=2) + "\n", encoding="utf-8")
    made = sections.provenance(seconds, work.wanted.pace)
    logs = sections.log_entries(work.folder)
    lead = "The paper's tables and figures beside ours, on simulated rigs. The paper's rig is not ours: its numbers are a scale."
    (work.folder / PAGE).write_text(page_of("Reproduction", lead, work.sections, logs, made), encoding="utf-8")
