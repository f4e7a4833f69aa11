"""The sections of the reproduction's page, and the same as numbers; each from what one step of `deploy.reproduce` left."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from softloop.deploy.experiment_pressure import RUNS
from softloop.deploy.experiment_pressure import judge as judge_pressure
from softloop.deploy.experiment_tracking import RESULT as TRACKING
from softloop.deploy.experiment_tracking import paper_of
from softloop.deploy.experiment_valves import FIGURE as FIG_4
from softloop.deploy.experiment_valves import RESULT as VALVES
from softloop.offline.evaluation import PAPER_DEG
from softloop.offline.excitation import BAR_KPA
from softloop.offline.excitation_figure import figure_2ab
from softloop.offline.identification.experiments import FAST
from softloop.offline.identification.figures import validation
from softloop.offline.identification.orders import compare
from softloop.offline.identification.structure import PAPER
from softloop.offline.laws_figure import figure_67
from softloop.offline.reproduction import MEMORY, PAPER_FITS, SLOW, Identified, table1, words_of
from softloop.offline.reproduction_page import DASH, LogEntry, Picture, Row, Section, TableOf, figures, number
from softloop.offline.run_log import find_log, open_run
from softloop.offline.vector import as_bytes
from softloop.wire.log_parts import parts_of
from softloop.wire.mcap_layout import git_state, versions

Sections = list[Section]
Numbers = dict[str, Any]


def log_of(folder: Path, run: Path) -> str:
    """A run's log, relative to the page."""
    return str(find_log(run).relative_to(folder))


def add_pressure(sections: Sections, numbers: Numbers, folder: Path, experiment: Path) -> None:
    """Figs. 2a and 2b."""
    found = judge_pressure(experiment)
    numbers["pressure"] = json.loads((experiment / "pressure.json").read_text(encoding="utf-8"))
    rows = tuple(
        Row((RUNS[name], number(run.max_kpa), number(run.rms_kpa), number(run.truth_max_kpa)), log_of(folder, experiment / name))
        for name, run in found.items()
    )
    heads = ("run", "largest, kPa", "RMS, kPa", "true pressure, largest, kPa")
    note = (
        f"As measured; aimed at: {BAR_KPA:g} kPa. In the true pressure's error is the sensor's own. The paper prints no number."
    )
    drawn = as_bytes(figure_2ab({RUNS[name]: run for name, run in found.items()}), "svg")
    section = Section("Pressure tracking, Figs. 2a and 2b")
    section.parts = [TableOf("Chamber pressure less desired", heads, rows, note), Picture("As Figs. 2a and 2b.", drawn)]
    sections.append(section)


def add_identification(
    sections: Sections, numbers: Numbers, folder: Path, found: Identified, progress: Callable[[int, int], None]
) -> None:
    """Table 1, fits, orders, Figs. 2c and 2d."""
    logs = {"Data1": folder / "pressure" / FAST, "Data2": folder / "pressure" / FAST, "Data3": folder / "pressure" / SLOW}
    source = {name: log_of(folder, run) for name, run in logs.items()}
    numbers["identification"] = {m.key: _model(found, m.key) | {"logs": source} for m in found.models}
    section = Section("Identification, Eqs. 6 to 10, Table 1, Figs. 2c and 2d")
    section.parts = [_fits(found, source), *_tables_1(found, source["Data1"]), _orders(found, source["Data1"], numbers, progress)]
    drawn = as_bytes(validation(found.model("oe").fit, list(found.series[1:])), "svg")
    section.parts.append(
        Picture("As Figs. 2c and 2d: free simulation of Data2 and Data3 by Eq. 2, identified by output error.", drawn)
    )
    section.lead = "; ".join(found.left_out)
    sections.append(section)


def _model(found: Identified, key: str) -> dict[str, Any]:
    model = found.model(key)
    content: dict[str, Any] = {"method": model.words, "fit_percent": model.scores, "values": model.fit.named()}
    if model.sure is not None:
        low, high = model.sure.interval()
        content["interval_95"] = {n: [a, b] for n, a, b in zip(model.sure.names, low.tolist(), high.tolist(), strict=True)}
    return content


def _fits(found: Identified, source: dict[str, str]) -> TableOf:
    rows = [
        Row(("the paper, Eq. 2", DASH, number(PAPER_FITS["Data2"], 4), number(PAPER_FITS["Data3"], 4)), "section 2.1", link=False)
    ]
    for model in found.models:
        if model.key != "ls_white":  # the same values as ls, with other intervals
            words = model.words.split(", intervals")[0]
            rows.append(Row((words, *(number(model.scores[d], 2) for d in source)), source["Data1"]))
    note = "NRMSE fit of a free simulation, %. Trained on Data1; Data2 is the second half of the same log, "
    note += f"Data3 is {source['Data3']}."
    return TableOf("Fits", ("model", "Data1 (trained)", "Data2", "Data3"), tuple(rows), note)


def _tables_1(found: Identified, source: str) -> list[TableOf]:
    tables = []
    for key in ("ls_white", "ls", "iv", "oe"):
        model = next((m for m in found.models if m.key == key), None)
        if model is not None and model.sure is not None:
            low, high = model.sure.interval()
            ends = {n: (v, a, b) for n, v, a, b in zip(model.sure.names, model.sure.values, low, high, strict=True)}
            rows = tuple(_row_of_table_1(n, paper, ends[n], source) for n, paper in table1().items())
            heads = ("parameter", "paper", "printed interval", "ours", "95 % interval")
            tables.append(TableOf(f"Table 1 by: {model.words}", heads, rows))
    return tables


def _row_of_table_1(name: str, paper: tuple[float, float, float], ours: tuple[float, float, float], source: str) -> Row:
    spans = [f"{figures(a)} to {figures(b)}" for _, a, b in (paper, ours)]
    return Row((name, figures(paper[0]), spans[0], figures(ours[0]), spans[1]), source)


def _orders(found: Identified, source: str, numbers: Numbers, progress: Callable[[int, int], None]) -> TableOf:
    choices = compare(PAPER, found.series[0], list(found.series[1:]), progress)
    rows, kept = [], []
    for c in choices:
        s = c.structure
        fits = [c.fit, *c.validation]
        kept.append({"m": s.m, "n": s.n, "r": s.r, "fits_percent": fits, "schwarz": c.schwarz, "uncertain": c.uncertain})
        cells = (
            f"{s.m}, {s.n}, {s.r}",
            str(len(s.names)),
            *(number(f) for f in fits),
            number(c.schwarz, 4),
            " ".join(c.uncertain) or DASH,
        )
        rows.append(Row(cells, source))
    numbers["orders"] = kept
    heads = ("m, n, r", "values", "Data1", "Data2", "Data3", "Schwarz", "interval holds 0")
    return TableOf(
        "Orders: the paper weighed them and took 2, 0, 3",
        heads,
        tuple(rows),
        "Fit by free simulation, %; less is better in Schwarz's.",
    )


def add_valves(sections: Sections, numbers: Numbers, folder: Path, experiment: Path, runs: list[Path]) -> None:
    """Fig. 4 and the coefficients of Eq. 16."""
    found = json.loads((experiment / VALVES).read_text(encoding="utf-8"))
    numbers["valves"] = found
    source = ", ".join(log_of(folder, run) for run in runs)
    section = Section(
        "Valves, Eqs. 12 and 16, Fig. 4", "The paper prints no coefficient of its valves, so that only Fig. 4's form compares."
    )
    for valve, one in found.items():
        rows = [
            Row((n, figures(r["value"]), f"{figures(r['low'])} to {figures(r['high'])}"), source, link=False)
            for n, r in one["numbers"].items()
        ]
        rows += [Row((name, "not identifiable", DASH), source, link=False) for name in one["not_identifiable"]]
        title = f"{valve} valve: fit {one['fit_percent']:.2f} %, rank {one['rank']} of {one['of']}, {one['tests']} tests"
        section.parts.append(TableOf(title, ("number", "value", "95 % interval"), tuple(rows)))
    section.parts.append(
        Picture("As Fig. 4: marks measured, lines the model.", (experiment / FIG_4).with_suffix(".svg").read_bytes())
    )
    sections.append(section)


def add_tracking(sections: Sections, numbers: Numbers, folder: Path, experiment: Path) -> None:
    """Figs. 6 and 7 and the errors of section 4.2."""
    found = json.loads((experiment / TRACKING).read_text(encoding="utf-8"))
    numbers["tracking"] = found
    section = Section("Tracking, Figs. 6 and 7, section 4.2")
    section.parts.append(
        TableOf("Error, true angle less reference, deg", _HEADS, tuple(_tracking_rows(folder, experiment, found)))
    )
    for trajectory, name in (("t1", "6"), ("t2", "7")):
        logs = {row["law"]: open_run(experiment / run) for run, row in found.items() if row["trajectory"] == trajectory}
        drawn = as_bytes(figure_67(logs, "arc"), "svg")
        section.parts.append(Picture(f"As Fig. {name}: {trajectory.upper()}; (b) and (d) of the paper's controller C3.", drawn))
    sections.append(section)


_HEADS = ("law", "on", "largest", "paper", "steady", "paper", "RMS")


def _tracking_rows(folder: Path, experiment: Path, found: dict[str, dict[str, Any]]) -> list[Row]:
    rows = []
    for name, row in found.items():
        largest, steady = paper_of(row["law"], row["trajectory"])
        cells = (number(row["max_deg"]), number(largest), number(row["steady_deg"]), number(steady), number(row["rms_deg"], 3))
        rows.append(Row((row["law"], row["trajectory"].upper(), *cells), log_of(folder, experiment / name)))
    return rows


def add_other(sections: Sections, numbers: Numbers, folder: Path) -> None:
    """Identified parameters against Table 1 on a rig that is not the paper's."""
    both = {name: json.loads((folder / name / TRACKING).read_text(encoding="utf-8")) for name in ("other_table1", "other_own")}
    numbers["another_rig"] = both
    rows = []
    for run, before in both["other_table1"].items():
        after = both["other_own"][run]
        pairs = [number(d[key], 3) for key in ("max_deg", "rms_deg") for d in (before, after)]
        sources = ", ".join(log_of(folder, folder / name / run) for name in both)
        rows.append(Row((before["law"], before["trajectory"].upper(), *pairs), sources, link=False))
    heads = ("law", "on", "largest, Table 1", "largest, identified", "RMS, Table 1", "RMS, identified")
    lead = (
        "The actuator is 12 % stiffer than Table 1, with 10 % less torque from pressure and 15 % more damping (parameters firm)."
    )
    section = Section("Another rig: on Table 1, and on parameters identified from its own logs", lead)
    note = (
        "smc and arc size their robust terms by the parameters' bounds (Eqs. 38 and 47). The identified ones are wide enough for "
        "what the parameters do together, three standard errors of the acceleration, and not of each parameter alone."
    )
    section.parts.append(TableOf("Error, true angle less reference, deg", heads, tuple(rows), note))
    sections.append(section)


def add_seeds(sections: Sections, numbers: Numbers, found: Numbers, seeds: str) -> None:
    """Fits over many rigs, as `FitTally` counts them."""
    numbers["fits_over_rigs"] = found
    rows = []
    for key, words in (("oe", "Eq. 2"), ("memory", f"Eq. 2 with {words_of(MEMORY)}")):
        for data, over in found["models"][key].items():
            cells = (f"{words}, {data}", number(over["median"]), number(over["worst"]), number(PAPER_FITS[data]))
            rows.append(Row(cells, f"seeds {seeds}, in one process", link=False))
    section = Section("Fits over rigs", "Rig layer, each rig drawn by its seed; trained on its Data1.")
    section.parts.append(
        TableOf("NRMSE fit of a free simulation, %", ("model", "median", "worst", "paper's one rig"), tuple(rows))
    )
    sections.append(section)


def add_evaluation(sections: Sections, numbers: Numbers, found: dict[str, dict[str, Any]], seeds: str) -> None:
    """Laws over many rigs."""
    numbers["evaluation"] = found
    keys = ("t1_max_deg", "t1_steady_deg", "t2_max_deg")
    paper = {"arc": tuple(number(PAPER_DEG[k]) for k in ("t1", "steady", "t2"))}
    rows = []
    for law, one in found.items():
        cells = [f"{number(one[k]['worst'])} ({number(one[k]['median'])})" for k in keys]
        rows.append(Row((law, *cells, f"{one['paper_kept']} of {one['rigs']}"), f"seeds {seeds}, in one process", link=False))
    rows.append(Row(("the paper's ARC, one rig", *paper["arc"], DASH), "section 4.2", link=False))
    heads = ("law", "T1 largest", "T1 steady", "T2 largest", "rigs within the paper's three")
    section = Section("Laws over rigs", "Worst rig, and the median in brackets; deg. Gains tuned on other rigs.")
    section.parts.append(TableOf("Error, true angle less reference, deg", heads, tuple(rows)))
    sections.append(section)


def add_coverage(sections: Sections, numbers: Numbers, counted: Path | None) -> None:
    """Whether intervals hold what they say."""
    if counted is None:
        return
    found = json.loads(counted.read_text(encoding="utf-8"))
    numbers["coverage"] = found
    source = f"seeds {found['first_seed']}:{found['first_seed'] + found['rigs']}, in one process"
    methods = found["methods"]
    rows = []
    for name in next(iter(methods.values())):
        counts = (by_name[name] for by_name in methods.values())
        cells = (f"{100 * row['held']:.1f} ({100 * row['low']:.1f} to {100 * row['high']:.1f})" for row in counts)
        rows.append(Row((name, *cells), source, link=False))
    section = Section(
        "Coverage",
        f"{found['rigs']} ideal rigs: the share of 95 % intervals that hold the true value, %, with its binomial interval.",
    )
    section.parts.append(TableOf("Held, %", ("parameter", *methods), tuple(rows)))
    sections.append(section)


def log_entries(folder: Path) -> list[LogEntry]:
    """Every log under `folder`, with its hash and whether its summary calls it valid evidence."""
    found = []
    for log in sorted(folder.rglob("run.mcap")):
        digest = hashlib.sha256(b"".join(part.read_bytes() for part in parts_of(log))).hexdigest()
        found.append(LogEntry(str(log.relative_to(folder)), digest, _valid(log.parent / "summary.json")))
    return found


def _valid(summary: Path) -> str:
    try:
        content = json.loads(summary.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return "unknown: no summary"
    return "yes" if content.get("evidence_valid") else f"no: {content.get('evidence_problems')}"


def provenance(seconds: float, pace: str) -> dict[str, str]:
    """What made the page."""
    git = git_state(Path(__file__).resolve().parent)
    commit = "unknown" if not git["commit"] else f"{git['commit']}{', with changes' if git['dirty'] else ''}"
    return {**versions(), "commit": commit, "pace of the experiments": pace, "took": f"{seconds:.0f} s"}
