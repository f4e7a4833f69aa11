"""Many runs in this process's way: every law and trajectory on the rigs of many seeds, and what their scores say together."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from math import inf, isfinite
from typing import Any

import numpy as np

from softloop.controller.config import ControllerConfig
from softloop.controller.records import ANGLE_LAWS
from softloop.controller.setup import plan_of
from softloop.offline.closed_loop import SETTLE_S, RigTables, simulate_tables
from softloop.offline.evaluation import tuned
from softloop.offline.metrics import Floats
from softloop.offline.scores import Scores, run_scores
from softloop.offline.summary import PAPER_T1, PAPER_T2
from softloop.plant.config import LoadConfig
from softloop.plant.mismatch import draw
from softloop.wire.errors import BadConfig
from softloop.wire.schedule import START_NS

PAYLOAD_DEG_S2 = 400.0
PAYLOAD_SPAN = (0.32, 0.64)  # of the trajectory, on which it hangs; on T1 it comes and leaves on a dwell
PAPER = {"t1": PAPER_T1["ARC (C3)"], "t2": PAPER_T2["ARC (C3)"]}  # largest and steady error of the paper's best, deg
FEWEST_FOR_INFLUENCE = 30  # rigs from which a rank correlation is said
_VALVES, _SENSOR = ("charge", "exhaust"), ("gain", "zero")
_PARTS = {  # of what is drawn several at once
    "k_v1": _VALVES,
    "k_v6": _VALVES,
    "play_fraction": _VALVES,
    "supply_sensor": _SENSOR,
    "chamber_sensor": _SENSOR,
    "theta_fraction": ("a0", "a1", "a2", "c0", "c1", "c2", "c3", "d", "b0"),
    "phases": ("driver", "analog", "inclinometer"),
}
SCORE_NAMES = tuple(f.name for f in fields(Scores))


@dataclass(frozen=True)
class Case:
    """One run of a campaign."""

    law: str
    trajectory: str
    seed: int
    payload: bool = False
    tuned: bool = False  # the law's shipped tuned `[controller]`, not the bench's

    @property
    def group(self) -> Group:
        return Group(self.law, self.trajectory, self.payload)


@dataclass(frozen=True)
class Group:
    """The runs that are taken together: one law on one trajectory, with the payload or without."""

    law: str
    trajectory: str
    payload: bool = False


@dataclass(frozen=True)
class Result:
    """What one run came to. `fault` says why its gate went to FAULT; empty when it did not."""

    case: Case
    scores: Scores
    fault: str = ""
    completed: bool = True


@dataclass(frozen=True)
class Spread:
    """Median, 95 % and worst of a score over rigs; values that did occur (the next higher one), infinite where runs were lost."""

    median: float
    p95: float
    worst: float


@dataclass(frozen=True)
class Verdict:
    """One group's row.

    Attributes:
        rigs: how many.
        lost: of them, with a gate fault or not brought to the end.
        spreads: name of a score -> its spread; without those that these runs do not have.
        under_paper: share of rigs that stay under the paper's ARC figures: of each score that the paper has for this trajectory,
            and under "both" of all of them at once; empty for a trajectory that the paper has not.
        worst: the run with the largest error.
        influences: (name of a draw, its rank correlation with the largest error), strongest first; empty for few rigs.
    """

    group: Group
    rigs: int
    lost: int
    spreads: dict[str, Spread]
    under_paper: dict[str, float]
    worst: Result
    influences: list[tuple[str, float]]


def plan_cases(
    laws: Sequence[str], trajectories: Sequence[str], seeds: Iterable[int], *, payload: bool, tuned: bool = False
) -> list[Case]:
    """All runs of a campaign, group by group: without the payload, and where it is asked for with it too."""
    kinds = (False, True) if payload else (False,)
    return [Case(law, t, seed, with_it, tuned) for with_it in kinds for t in trajectories for law in laws for seed in seeds]


def controller_for(tables: RigTables, case: Case) -> ControllerConfig:
    """The bench's `[controller]`, or the law's tuned one, with a run's law and trajectory. Raises BadConfig on an unknown law."""
    base = tuned(case.law)[0] if case.tuned else tables.controller
    content = base.model_dump() | {"law": case.law, "trajectory": case.trajectory}
    config = ControllerConfig.model_validate(content)
    if config.law not in ANGLE_LAWS:
        raise BadConfig(f'law "{config.law}" follows no angle: a campaign judges angles')
    return config


def case_tables(tables: RigTables, case: Case) -> tuple[RigTables, tuple[int, ...]]:
    """The tables of one run, and the rig clock at which its loads come and leave.

    Raises BadFile or BadConfig.
    """
    controller = controller_for(tables, case)
    loads = tables.plant.loads
    if case.payload:
        start_s, length_s = SETTLE_S + controller.approach_s, plan_of(controller).duration_s
        on_s, off_s = (start_s + share * length_s for share in PAYLOAD_SPAN)
        loads = (*loads, LoadConfig(kind="payload", on_s=on_s, off_s=off_s, size=PAYLOAD_DEG_S2))
    plant = tables.plant.model_copy(update={"seed": case.seed, "loads": loads})
    changes = sorted(START_NS + round(at_s * 1e9) for load in loads for at_s in (load.on_s, load.off_s))
    return replace(tables, controller=controller, plant=plant), tuple(changes)


def run_case(tables: RigTables, case: Case) -> Result:
    """One run and its scores. Raises BadFile or BadConfig."""
    own, changes_ns = case_tables(tables, case)
    run = simulate_tables(own)
    return Result(case, run_scores(run, changes_ns), run.fault, run.completed)


def run_cases(tables: RigTables, cases: Sequence[Case]) -> list[Result]:
    """Some runs, one after the other: what a worker is given. Raises BadFile or BadConfig."""
    return [run_case(tables, case) for case in cases]


def verdicts(results: Sequence[Result]) -> list[Verdict]:
    """One row per group, in the order in which they come."""
    groups: dict[Group, list[Result]] = {}
    for result in results:
        groups.setdefault(result.case.group, []).append(result)
    return [judge(group, found) for group, found in groups.items()]


def judge(group: Group, results: Sequence[Result]) -> Verdict:
    """What the runs of one group say together."""
    errors = np.array([r.scores.max_error_deg for r in results])
    columns = {name: [getattr(r.scores, name) for r in results] for name in SCORE_NAMES}
    spreads = {name: spread(np.array(found)) for name, found in columns.items() if None not in found}
    return Verdict(
        group=group,
        rigs=len(results),
        lost=sum(not isfinite(e) for e in errors),
        spreads=spreads,
        under_paper=_shares_under_paper(group, results),
        worst=results[int(errors.argmax())],
        influences=influences([r.case.seed for r in results], errors),
    )


def spread(values: Floats) -> Spread:
    """Median, 95 % and worst of (n,) values, n > 0."""
    median, p95 = np.percentile(values, (50.0, 95.0), method="higher")
    return Spread(float(median), float(p95), float(values.max()))


def _shares_under_paper(group: Group, results: Sequence[Result]) -> dict[str, float]:
    limits = paper_limits(group.trajectory)
    if not limits:
        return {}
    under = {name: [(_number(r.scores, name)) < limit for r in results] for name, limit in limits.items()}
    under["both"] = [all(flags) for flags in zip(*under.values(), strict=True)]
    return {name: float(np.mean(flags)) for name, flags in under.items()}


def paper_limits(trajectory: str) -> dict[str, float]:
    """Name of a score -> the paper's figure for its ARC on this trajectory; empty where it has none."""
    dynamic, steady = PAPER.get(trajectory, (None, None))
    found = {"max_error_deg": dynamic, "steady_error_deg": steady}
    return {name: limit for name, limit in found.items() if limit is not None}


def _number(scores: Scores, name: str) -> float:
    value = getattr(scores, name)
    return inf if value is None else float(value)


def drawn_values(seed: int) -> dict[str, float]:
    """What a rig was drawn with (`plant.mismatch`), name -> value."""
    found: dict[str, float] = {}
    for name, value in asdict(draw(seed)).items():
        if name in _PARTS:
            found |= {f"{name}_{part}": inner for part, inner in zip(_PARTS[name], value, strict=True)}
        else:
            found[name] = value
    return found


def influences(seeds: Sequence[int], errors: Floats) -> list[tuple[str, float]]:
    """Spearman's rank correlation of each draw with (n,) errors, strongest first; empty for fewer than 30 rigs."""
    if len(seeds) < FEWEST_FOR_INFLUENCE:
        return []
    drawn = [drawn_values(seed) for seed in seeds]
    ranks = _ranks(errors)
    found = [(name, float(np.corrcoef(_ranks(np.array([d[name] for d in drawn])), ranks)[0, 1])) for name in drawn[0]]
    return sorted((pair for pair in found if isfinite(pair[1])), key=lambda pair: -abs(pair[1]))


def _ranks(values: Floats) -> Floats:
    """Ranks of (n,) values, equal ones sharing their mean rank."""
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(count)
    return np.asarray((last - 0.5 * (count - 1))[place], np.float64)


def as_dict(verdict: Verdict) -> dict[str, Any]:
    """A verdict for JSON (infinities still in it)."""
    worst = verdict.worst
    return {
        **asdict(verdict.group),
        "rigs": verdict.rigs,
        "lost": verdict.lost,
        "scores": {name: asdict(found) for name, found in verdict.spreads.items()},
        "under_paper": verdict.under_paper,
        "worst": result_dict(worst) | {"drawn": drawn_values(worst.case.seed)},
        "influences": dict(verdict.influences),
    }


def result_dict(result: Result) -> dict[str, Any]:
    """A run for JSON (infinities still in it)."""
    return {**asdict(result.case), **asdict(result.scores), "fault": result.fault, "completed": result.completed}
