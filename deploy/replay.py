"""`softloop replay`: what a replay found, said to a person or as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from softloop.controller.config import ControllerConfig
from softloop.deploy.bench import find_bench, load_bench
from softloop.deploy.progress import tick_progress
from softloop.offline.replay import Deviation, Difference, ReplayResult, installation_differences, logged_controller, replay
from softloop.offline.run_log import open_run
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK, BadConfig

STRETCHES_SHOWN = 10
_UNITS = {"charge_current_ma": "charge current, mA", "exhaust_current_ma": "exhaust current, mA"}
_UNITS |= {"desired_pressure_kpa": "desired pressure, kPa"}
_COURSE = ("trajectory", "trajectory_seed", "approach_s")


def replay_run(run: Path, controller: Path | None, *, as_json: bool) -> int:
    """Replay a run, with its own controller or that of a bench file, and say what was found.

    Returns:
        EXIT_NEGATIVE when its own controller does not give what was logged, else EXIT_OK.

    Raises:
        BadFile, BadConfig: the log or the bench file cannot be used.
    """
    other = None if controller is None else _controller_of(controller)
    log = open_run(run)
    elsewhere = installation_differences(log)
    if not as_json and elsewhere:
        print(f"this installation is not the one of the log: {'; '.join(elsewhere)}", flush=True)
    with tick_progress(quiet=as_json) as progress:
        result = replay(log, other, progress)
    if as_json:
        print(json.dumps(_as_dict(result, elsewhere, log.problems, own=other is None), indent=2, allow_nan=False))
    else:
        course = [] if other is None else _another_course(logged_controller(log), other)
        said = _said(result) if other is None else _said_of_another(result)
        print("\n".join([*log.problems, *course, *_not_compared(result), *said]))
    return EXIT_OK if result.equal or other is not None else EXIT_NEGATIVE


def _controller_of(bench_file: Path) -> ControllerConfig:
    found = load_bench(find_bench(bench_file)).controller
    if found is None:
        raise BadConfig(f"{bench_file}: has no table [controller] to replay with")
    return found


def _not_compared(result: ReplayResult) -> Iterator[str]:
    if result.absent:
        yield f"the log is of another layout; not in it: {', '.join(result.absent)}"
    for tick in result.restarts:
        yield f"tick {tick}: the controller was started again"
    for stretch in result.stretches[:STRETCHES_SHOWN]:
        name = f"tick {stretch.first_tick}" if stretch.recorded == 1 else f"ticks {stretch.first_tick} to {stretch.last_tick}"
        yield f"{name}: not comparable, state taken from the record: {stretch.why}"
    if len(result.stretches) > STRETCHES_SHOWN:
        yield f"and {len(result.stretches) - STRETCHES_SHOWN} more stretches that are not comparable (all of them with --json)"
    if result.commands < result.compared:
        yield f"{result.compared - result.commands} commands are not in the log; their cycle records are compared"


def _said(result: ReplayResult) -> Iterator[str]:
    counts = f"{result.compared} of {result.ticks} ticks and {result.commands} commands compared"
    first = result.first
    if first is None:
        yield f"equal: {counts}, bit for bit (law {result.law})"
        return
    yield f"different at tick {first.tick}: {first.field}: logged {first.logged!r}, replayed {first.replayed!r}"
    ticks = ", ".join(f"{name} {count}" for name, count in result.differing.items())
    yield f"{counts} (law {result.law}); ticks that differ, by field: {ticks}"


def _another_course(own: ControllerConfig, other: ControllerConfig) -> list[str]:
    """A line when the two do not follow the same trajectory, which then explains most of what differs."""
    apart = [f"{n} {getattr(own, n)} and {getattr(other, n)}" for n in _COURSE if getattr(own, n) != getattr(other, n)]
    return [f"the two follow different trajectories: {', '.join(apart)}"] if apart else []


def _said_of_another(result: ReplayResult) -> Iterator[str]:
    apart = result.deviation
    yield f"law {result.law} on the log's inputs, {apart.ticks} ticks of approach and trajectory, against the logged commands:"
    for name, shown in _UNITS.items():
        yield f"{shown}: rms {apart.rms(name):.4g}, at most {apart.maximum[name]:.4g}"
    yield f"another working mode on {100.0 * apart.other_mode_share:.1f} % of the ticks"


def _as_dict(result: ReplayResult, elsewhere: list[str], problems: list[str], *, own: bool) -> dict[str, Any]:
    return {
        "own_controller": own,
        "equal": result.equal,
        "law": result.law,
        "ticks": result.ticks,
        "compared": result.compared,
        "commands_compared": result.commands,
        "first_difference": None if result.first is None else _difference(result.first),
        "differing_ticks": result.differing,
        "deviation": _deviation(result.deviation),
        "not_comparable": [asdict(s) for s in result.stretches],
        "restarts": result.restarts,
        "absent_fields": result.absent,
        "installation_differences": elsewhere,
        "log_problems": problems,
    }


def _difference(first: Difference) -> dict[str, Any]:
    return asdict(first) | {"logged": _number(first.logged), "replayed": _number(first.replayed)}


def _deviation(apart: Deviation) -> dict[str, Any]:
    quantities = {f"{name}_{kind}": _number(value) for name in _UNITS for kind, value in _both(apart, name)}
    return {"ticks": apart.ticks, **quantities, "other_mode_share": apart.other_mode_share}


def _both(apart: Deviation, name: str) -> tuple[tuple[str, float], tuple[str, float]]:
    return ("rms", apart.rms(name)), ("max", apart.maximum[name])


def _number(value: float) -> float | str:
    """JSON has no NaN and no infinity: those as text."""
    return value if math.isfinite(value) else str(value)
