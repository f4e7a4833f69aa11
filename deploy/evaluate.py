"""`softloop evaluate`: the comparison of laws with its progress, its tables, its pictures, and its runs over the whole stack."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from softloop.deploy.confirm import Pace, confirm_runs, confirmed_table
from softloop.deploy.tune import seeds_of
from softloop.offline.closed_loop import simulate_run
from softloop.offline.comparison_figures import save, side_by_side
from softloop.offline.evaluation import (
    CONDITIONS,
    LAWS,
    OWN,
    PAPER_DEG,
    RECOVERY_S,
    Verdict,
    evaluate,
    figures,
    tuned,
)
from softloop.offline.tuning import BARS_DEG, SWITCHES_PER_S
from softloop.plant.config import PlantConfig
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK, BadConfig

_COLUMNS = {
    "T1": "t1_max_deg",
    "steady": "t1_steady_deg",
    "T2": "t2_max_deg",
    "payload": "payload_peak_deg",
    "back, s": "payload_recovery_s",
    "leaves": "left_peak_deg",
    "switches": "dwell_switches_per_s",
    "on T2": "t2_switches_per_s",
    "effort": "t2_effort_ma_s",
}
_WIDTH = 210  # wider than most terminals, so that a page can show it whole
_KEPT = {"bars": "bars_kept", "load": "payload_kept", "quiet": "quiet", "paper": "paper_kept"}
_SHARE_OF_RIGS = 0.9  # of the rigs on which the bars must hold: 18 of 20


def run_evaluate(seeds: str, laws: str, only: str, figures_dir: Path | None, confirm: int, pace: Pace, *, as_json: bool) -> int:
    """Evaluate, show; exit code 1 where `arc_eso` at the rig's own latency misses a bar. Raises BadFile or BadConfig."""
    rigs, chosen = seeds_of(seeds), _laws(laws)
    conditions = [c for c in CONDITIONS if only in ("", c.name)]
    if not conditions:
        raise BadConfig(f"condition '{only}': there is none of that name; there are: {', '.join(c.name for c in CONDITIONS)}")
    with Progress(console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("evaluating", total=None)
        verdicts = evaluate(chosen, conditions, rigs, lambda done, total: bar.update(task, completed=done, total=total))
    confirmed = confirm_runs(chosen, rigs[:confirm], pace) if confirm else []
    if figures_dir is not None:
        draw(chosen, rigs[0], figures_dir)
    latency = latency_budget(chosen[-1], rigs[0])
    if as_json:
        content = [v.content() for v in verdicts]
        print(json.dumps({"seeds": seeds, "latency_ms": latency, "verdicts": content, "whole_stack": confirmed}))
    else:
        show(verdicts, latency, confirmed)
    return EXIT_OK if _kept(verdicts) else EXIT_NEGATIVE


def _laws(text: str) -> tuple[str, ...]:
    chosen = tuple(name.strip() for name in text.split(",")) if text else LAWS
    for name in chosen:
        if name not in LAWS:
            raise BadConfig(f"law '{name}' is not evaluated; these are: {', '.join(LAWS)}")
    return chosen


def _kept(verdicts: Sequence[Verdict]) -> bool:
    for verdict in verdicts:
        if verdict.law == "arc_eso" and verdict.condition == OWN.name:
            found = figures(verdict.judged)
            return all(found[n] >= _SHARE_OF_RIGS * found["rigs"] for n in ("bars_kept", "payload_kept", "quiet"))
    return True


def latency_budget(law: str, seed: int) -> dict[str, float]:
    """Median ages at the tick, and from the tick to the driver, in ms, in one T1 run at the rig's own latency."""
    controller, _ = tuned(law)
    run = simulate_run(controller, PlantConfig(seed=seed))
    cycles, truths = run.cycles[200:], run.truths[200:]
    answered = truths["command_applied_ns"] - np.roll(cycles["stamp_ns"], 1)
    return {
        "pressure_age_ms": 1e-6 * float(np.median(cycles["pressure_age_ns"])),
        "inclination_age_ms": 1e-6 * float(np.median(cycles["inclination_age_ns"])),
        "tick_to_driver_ms": 1e-6 * float(np.median(answered[1:])),
        "declared_tick_to_opening_ms": controller.actuation_delay_ms,
    }


def show(verdicts: Sequence[Verdict], latency: dict[str, float], confirmed: list[dict[str, Any]]) -> None:
    """One table per condition: the worst rig's figure, and the median's."""
    console = Console(width=_WIDTH)
    hops = ", ".join(f"{name.removesuffix('_ms').replace('_', ' ')} {value:.2f} ms" for name, value in latency.items())
    console.print(f"latency budget: {hops}")
    for condition in dict.fromkeys(v.condition for v in verdicts):
        title = f"{condition}: worst (median) of the rigs; deg, s, 1/s, mA/s"
        table = Table(title=title, title_justify="left")
        table.add_column("law, tuned at ms", no_wrap=True)
        for head in (*_COLUMNS, *_KEPT):
            table.add_column(head, justify="right", no_wrap=True)
        for verdict in (v for v in verdicts if v.condition == condition):
            at = "defaults" if verdict.tuned_at_ms is None else f"at +{verdict.tuned_at_ms:g}"
            table.add_row(f"{verdict.law} {at}", *_row(verdict))
        console.print(table)
    paper = ", ".join(f"{name} {bound:g}" for name, bound in PAPER_DEG.items())
    bars = ", ".join(f"{name} {bar:g}" for name, bar in BARS_DEG.items())
    console.print(f"bars, deg: {bars}; back under 0.5 deg in {RECOVERY_S:g} s; {SWITCHES_PER_S:g} switches per second on dwells")
    console.print(f"the paper's ARC, deg: {paper}")
    if confirmed:
        console.print(confirmed_table(confirmed))


def _row(verdict: Verdict) -> list[str]:
    found = figures(verdict.judged)
    cells = [f"{_short(found[name]['worst'])} ({_short(found[name]['median'])})" for name in _COLUMNS.values()]
    return cells + [f"{found[name]}/{found['rigs']}" for name in _KEPT.values()]


def _short(value: float) -> str:
    return f"{value:.2f}" if value < 10.0 else f"{value:.1f}" if value < 100.0 else f"{value:.0f}"


def draw(laws: Sequence[str], seed: int, folder: Path) -> None:
    """Figs. 6 and 7 of every law side by side, on one rig."""
    folder.mkdir(parents=True, exist_ok=True)
    for trajectory, name in (("t1", "fig6_all_laws.png"), ("t2", "fig7_all_laws.png")):
        runs = {
            law: simulate_run(tuned(law)[0].model_copy(update={"trajectory": trajectory}), PlantConfig(seed=seed)) for law in laws
        }
        save(side_by_side(runs, f"{trajectory.upper()} on rig {seed}, every law with its tuned gains"), folder / name)
