"""`softloop identify`: parameters from logs or CSV files, with intervals, and how well they simulate what they have not seen."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic
from typing import Any

from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from softloop.deploy.destination import check_destination
from softloop.deploy.evidence import check_usable, write_evidence
from softloop.deploy.identify_files import Data, of_runs, of_tables, of_vents
from softloop.deploy.identify_words import say
from softloop.deploy.progress import counted_progress
from softloop.dynamics.parameters import load_parameters, shipped
from softloop.offline.identification.csv_map import parse_map, read_columns
from softloop.offline.identification.fitting import fit_output_error
from softloop.offline.identification.intervals import Uncertainty, of_fit, of_regression
from softloop.offline.identification.orders import compare
from softloop.offline.identification.output_error import Fit, score
from softloop.offline.identification.plausible import fit_hints, unit_hints
from softloop.offline.identification.regression import as_fit, instrumental_variables, least_squares
from softloop.offline.identification.series import Series
from softloop.offline.identification.structure import PAPER, Structure, bare_of
from softloop.offline.identification.valve_flow import NAMES as VALVE_NAMES
from softloop.offline.identification.valve_flow import FlowTests, fit_valve
from softloop.offline.identification.venting import fit_vent, score_vent
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK, BadConfig

WIDEST = 10_000  # columns; no table is


@dataclass(frozen=True)
class Asked:
    """What the command line asks for."""

    runs: tuple[Path, ...]
    csv: tuple[Path, ...]
    columns: tuple[str, ...]
    orders: str
    hysteresis: int
    creep: int
    delay: bool
    lag: bool
    at_rest: bool
    method: str
    interval: str
    select: bool
    output: Path | None
    figure: Path | None
    as_json: bool


@dataclass(frozen=True)
class Answer:
    """A model, how sure it is, and how it does on other data."""

    fit: Fit
    uncertainty: Uncertainty
    train: Series
    scores: dict[str, float]
    seen: frozenset[str]  # names of those in `scores` that are the training data again
    fit_s: float  # how long the fit took, with its intervals
    hints: tuple[str, ...]


def identify(asked: Asked) -> int:
    """Do what was asked and say it. Raises BadFile or BadConfig."""
    _check_files(asked)
    data = _data(asked)
    train, validate = data.train, data.validate
    structure = _structure(asked, train.pressure_kpa.shape[1])
    if asked.output:
        check_usable(asked.runs, structure)
    hints = _said(unit_hints([train, *validate]))  # before the fit, which wrong units may make long
    if asked.select:
        return _select(structure, data, as_json=asked.as_json)
    begun_s = monotonic()
    fit, uncertainty = fitted(structure, train, asked.method, asked.interval)
    fit_s = monotonic() - begun_s
    hints += _said(fit_hints({train.name: fit.fits[0]}))
    answer = Answer(fit, uncertainty, train, {v.name: score(fit, v) for v in validate}, data.seen, fit_s, tuple(hints))
    if asked.output:
        write_evidence(asked.output, asked.runs, fit, uncertainty, [train, *validate])
    if asked.figure:
        from softloop.offline.identification.figures import validation  # noqa: PLC0415 - matplotlib only where it draws
        from softloop.offline.vector import save  # noqa: PLC0415

        save(validation(fit, [train, *validate]), asked.figure)
    if asked.as_json:
        print(json.dumps(as_dict(answer), indent=2))
    else:
        _show(answer)
    return EXIT_OK


def identify_vent(files: tuple[Path, ...], columns: tuple[str, ...], trained: int, *, as_json: bool) -> int:
    """Fit the flow law to the ventings of the first `trained` files, score it on the others, and say it."""
    if not 1 <= trained <= len(files):
        raise BadConfig(f"--train {trained}: must be 1 to {len(files)}, the number of files")
    data = of_vents(files, parse_map(columns, ("time", "pressure"), ("input",)), trained)
    begun_s = monotonic()
    found = fit_vent(data.train)
    fit_s = monotonic() - begun_s
    sure, (low, high) = found.uncertainty, found.uncertainty.interval()
    own = {r.name: fit for r, fit in zip(data.train, found.fits, strict=True)}
    scores = {r.name: score_vent(sure.values, r) for r in data.validate}
    if as_json:
        rows = {n: {"value": v, "low": a, "high": b} for n, v, a, b in zip(sure.names, sure.values, low, high, strict=True)}
        answer = {"parameters": rows, "train": own, "validate": scores, "trained_on": sorted(data.seen), "rank": found.rank}
        print(json.dumps({**answer, "fit_s": fit_s}, indent=2))
        return EXIT_OK
    for name, value, a, b in zip(sure.names, sure.values, low, high, strict=True):
        print(f"{name} {value:.4g} (95 %: {a:.4g} to {b:.4g})")
    print(f"area, laminar conductance, wall and volume: rank {found.rank} of 4; only ratios to the volume are identifiable")
    for name, fit in own.items():
        print(f"  {name} (trained) {fit:.2f} %")
    for name, fit in scores.items():
        print(f"  {name} ({_seen(name, data.seen)}) {fit:.2f} %")
    print(_took(fit_s))
    return EXIT_OK


def identify_valve(file: Path, columns: tuple[str, ...], discharge: float, temperature_k: float, *, as_json: bool) -> int:
    """Fit a valve to flow tests and say it; EXIT_NEGATIVE when the tests do not show all of its numbers."""
    taken = read_columns(file, parse_map(columns, ("current", "upstream", "downstream", "flow")))
    found = fit_valve(FlowTests(*(taken[k] for k in ("current", "upstream", "downstream", "flow"))), discharge, temperature_k)
    sure, whole = found.uncertainty, found.rank == len(VALVE_NAMES)
    rows: dict[str, dict[str, float]] = {}
    if sure is not None:
        rows = {
            n: {"value": v, "low": a, "high": b} for n, v, a, b in zip(sure.names, sure.values, *sure.interval(), strict=True)
        }
    if as_json:
        six = found.coefficients() if whole else {}
        print(json.dumps({"numbers": rows, "coefficients": six, "rank": found.rank, "fit": found.fit}, indent=2))
    else:
        print(f"flow fits {found.fit:.2f} % (NRMSE); rank {found.rank} of 5")
        for name, row in rows.items():
            print(f"{name} {row['value']:.4g} (95 %: {row['low']:.4g} to {row['high']:.4g})")
        hidden = ", ".join(n for n in VALVE_NAMES if n not in found.shown)
        if hidden:
            print(
                f"not identifiable from these tests, so no number is given: {hidden}; vary both pressures, three or more of each"
            )
    return EXIT_OK if whole else EXIT_NEGATIVE


def fitted(structure: Structure, train: Series, method: str, interval: str) -> tuple[Fit, Uncertainty]:
    """A model by `oe`, `iv` or `ls`, with its uncertainty."""
    if method == "oe":
        fit = fit_output_error(structure, [train])
        return fit, of_fit(fit, [train], interval)
    if structure != bare_of(structure) or interval == "bootstrap":
        raise BadConfig(f"--method {method} takes neither memory, delay, lag, --at-rest nor bootstrap; --method oe does")
    ls = least_squares(structure, train)
    found = ls if method == "ls" else instrumental_variables(structure, train, fit_output_error(structure, [train]).values[:-2])
    return as_fit(found, train), of_regression(found, interval)


def _data(asked: Asked) -> Data:
    """Training data, and the rest. Of logs, the first run's halves are Data1 and Data2; of CSV files, the first one trains."""
    if bool(asked.runs) == bool(asked.csv):
        raise BadConfig("identify needs either runs, or --csv FILE with --map, and not both")
    if asked.csv:
        return of_tables(asked.csv, parse_map(asked.columns))
    return of_runs(asked.runs)


def _said(hints: list[str]) -> list[str]:
    for hint in hints:
        say(hint)
    return hints


def _check_files(asked: Asked) -> None:
    """Whether what is to be written can be, before a long fit. Raises BadFile or BadConfig."""
    for option, target in (("--output", asked.output), ("--figure", asked.figure)):
        if target is not None:
            check_destination(target, option)
    if asked.figure:
        from softloop.offline.vector import format_of  # noqa: PLC0415 - matplotlib only where it draws

        format_of(asked.figure)


def _structure(asked: Asked, inputs: int) -> Structure:
    try:
        m, n, r = (int(part) for part in asked.orders.split(","))
    except ValueError:
        raise BadConfig(f"--orders {asked.orders}: must be m,n,r such as 2,0,3") from None
    if not all(0 <= order <= 6 for order in (m, n, r)):
        raise BadConfig(f"--orders {asked.orders}: each order is 0 to 6")
    return Structure(m, n, r, inputs, asked.hysteresis, asked.creep, asked.delay, asked.lag, asked.at_rest)


def as_dict(answer: Answer) -> dict[str, Any]:
    """All that was found, for programs."""
    low, high = answer.uncertainty.interval()
    sure = answer.uncertainty
    rows = zip(sure.names, sure.values, sure.errors, low, high, strict=True)
    return {
        "structure": asdict(answer.fit.structure),
        "intervals": sure.method,
        "parameters": {n: {"value": v, "error": e, "low": a, "high": b} for n, v, e, a, b in rows},
        "train": {answer.train.name: answer.fit.fits[0]},
        "validate": answer.scores,
        "trained_on": sorted(answer.seen),
        "fit_s": answer.fit_s,
        "hints": list(answer.hints),
    }


def _show(answer: Answer) -> None:
    sure = answer.uncertainty
    low, high = sure.interval()
    paper = _table1() if answer.fit.structure.inputs == 1 else {}
    shown = paper if set(PAPER.names) <= set(sure.names) else {}
    table = Table(title=f"{answer.train.name}: 95 % intervals, {sure.method}")
    for heading in ("parameter", "value", "low", "high", *(["Table 1", "printed interval"] if shown else [])):
        table.add_column(heading, justify="right")
    for i, name in enumerate(sure.names):
        beside = [shown.get(name, ("", ""))[0], shown.get(name, ("", ""))[1]] if shown else []
        table.add_row(name, f"{sure.values[i]:.5g}", f"{low[i]:.5g}", f"{high[i]:.5g}", *beside)
    _print_whole(table)
    print(f"fit by free simulation, NRMSE: {answer.train.name} (trained) {answer.fit.fits[0]:.2f} %")
    for name, fit in answer.scores.items():
        print(f"  {name} ({_seen(name, answer.seen)}) {fit:.2f} %")
    print(_took(answer.fit_s))


def _took(fit_s: float) -> str:
    return f"fitted in {fit_s:.1f} s"


def _print_whole(table: Table) -> None:
    """A table as wide as it is: cut off at a narrow terminal's or a pipe's edge, it would lose digits."""
    console = Console(highlight=False)
    needed = Measurement.get(console, console.options.update(max_width=WIDEST), table).maximum
    Console(highlight=False, width=max(console.width, needed)).print(table)


def _seen(name: str, seen: frozenset[str]) -> str:
    return "trained on" if name in seen else "unseen"


def _table1() -> dict[str, tuple[str, str]]:
    bending = load_parameters(shipped()).bending
    entries = {name: getattr(bending, name) for name in PAPER.names}
    return {name: (f"{e.value:.5g}", f"{e.min:.5g} to {e.max:.5g}") for name, e in entries.items()}


def _select(structure: Structure, data: Data, *, as_json: bool) -> int:
    begun_s = monotonic()
    with counted_progress("fitting structures", quiet=as_json) as progress:
        choices = compare(structure, data.train, data.validate, progress)
    if as_json:
        print(json.dumps([asdict(c) for c in choices], indent=2))
        return EXIT_OK
    table = Table(title=f"orders, trained on {data.train.name}; fit by free simulation in %")
    others = [v.name + " (trained on)" * (v.name in data.seen) for v in data.validate]
    for heading in ("m, n, r", "values", data.train.name, *others, "Schwarz", "interval holds 0"):
        table.add_column(heading, justify="right")
    best = min(choices, key=lambda c: c.schwarz)
    for c in choices:
        s, mark = c.structure, " *" if c is best else ""
        fits = [f"{f:.2f}" for f in (c.fit, *c.validation)]
        table.add_row(f"{s.m}, {s.n}, {s.r}", str(len(s.names)), *fits, f"{c.schwarz:.4f}{mark}", " ".join(c.uncertain) or "-")
    _print_whole(table)
    print(_took(monotonic() - begun_s))
    return EXIT_OK
