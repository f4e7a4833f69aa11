"""`softloop evaluate --confirm N`: runs of every law over the whole stack, beside the batch of the same rigs."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import tomlkit
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from softloop.deploy.bench import find_bench
from softloop.offline.evaluation import tuned
from softloop.offline.trials import run_trial
from softloop.plant.config import PlantConfig

Pace = Literal["wall", "lockstep"]
ATTEMPTS = 2  # at wall pace: a run in which the machine made the plant late says nothing of the law; it is counted and made again
_KEYS = {
    "max_deg": "truth_error_max_deg",
    "steady_deg": "truth_error_steady_deg",
    "valid": "evidence_valid",
    "problems": "evidence_problems",
    "gate_faults": "gate_faults",
    "faults": "gate_fault_reasons",
}


def confirm_runs(laws: Sequence[str], seeds: Sequence[int], pace: Pace) -> list[dict[str, Any]]:
    """T1 and T2 of every law, one `softloop run` each, at wall pace until one is whole and valid or ATTEMPTS are made.

    Each finished run is one line on stderr. Raises BadFile or BadConfig.
    """
    jobs = [(law, seed, trajectory) for law in laws for seed in seeds for trajectory in ("t1", "t2")]
    found = []
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not sys.stderr.isatty()) as bar:
        for law, seed, trajectory in bar.track(jobs, description=f"running at {pace} pace"):
            found.append(_confirmed(law, seed, trajectory, pace))
            bar.console.print(", ".join(f"{k} {v}" for k, v in found[-1].items()), soft_wrap=True, highlight=False)
    return found


def confirmed_table(confirmed: Sequence[dict[str, Any]]) -> Table:
    """The whole stack and batch side by side, one row per law, rig and trajectory; what is not valid evidence says why."""
    table = Table(title=f"{confirmed[0]['pace']} pace, all processes; deg", title_justify="left")
    for head in ("law", "rig", "trajectory", "max", "steady", "batch max", "batch steady", "attempts", "evidence"):
        table.add_column(head, justify="left" if head in ("law", "evidence") else "right", no_wrap=True)
    for run in confirmed:
        figures = (_cell(run[name]) for name in ("max_deg", "steady_deg", "batch_max_deg", "batch_steady_deg"))
        table.add_row(run["law"], str(run["seed"]), run["trajectory"].upper(), *figures, str(run["attempts"]), _evidence(run))
    return table


def _evidence(run: dict[str, Any]) -> str:
    if run["gate_faults"]:
        return f"ended by the gate: {run['faults']}"
    return "valid" if run["valid"] else f"not valid: {run['problems']}"


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _confirmed(law: str, seed: int, trajectory: str, pace: Pace) -> dict[str, Any]:
    controller = tuned(law)[0].model_copy(update={"trajectory": trajectory})
    batch = run_trial(controller, PlantConfig(seed=seed))
    run: dict[str, Any] = {}
    for attempt in range(1, (ATTEMPTS if pace == "wall" else 1) + 1):
        run = _run(law, seed, trajectory, pace) | {"attempts": attempt}
        if run["valid"] and not run["gate_faults"]:
            break
    steady = batch.steady_deg if trajectory == "t1" else None
    named = {"law": law, "seed": seed, "trajectory": trajectory, "pace": pace}
    return {**named, **run, "batch_max_deg": batch.max_deg, "batch_steady_deg": steady}


def _run(law: str, seed: int, trajectory: str, pace: Pace) -> dict[str, Any]:
    content = tomlkit.parse(find_bench(Path("sim")).read_text())
    content["plant"]["seed"] = seed
    content["controller"] = {**tuned(law)[0].model_dump(), "trajectory": trajectory}
    with tempfile.TemporaryDirectory(prefix="softloop-") as folder:
        bench, run_dir = Path(folder) / "bench.toml", Path(folder) / "run"
        bench.write_text(tomlkit.dumps(content))
        command = [sys.executable, "-m", "softloop.deploy.cli", "run", str(bench), "--run-dir", str(run_dir), "--pace", pace]
        code = subprocess.run([*command, "--no-report", "-q"], check=False).returncode
        path = run_dir / "summary.json"
        summary = json.loads(path.read_text()) if path.is_file() else {}
    return {"exit_code": code, **{name: summary.get(key) for name, key in _KEYS.items()}}
