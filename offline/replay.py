"""Feed the inputs of a log through the controller again and compare, bit for bit, everything it computed.

The very kernel of the 5 ms process runs on the very messages that each tick saw. A tick that cannot be run, because a sample
that it saw or the records before it are not in the log, is not compared: the state is taken over from its record, which holds
all of it (`controller.recall`), and the next tick is compared again.

With another controller the same inputs are run through that one, and the result says how far its commands are from those in
the log. The inputs stay the answers to the logged commands: what that controller would have done to the rig is not in them.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from softloop.controller.config import ControllerConfig
from softloop.controller.laws.arc import STEP1_TYPE
from softloop.controller.recall import recall, recall_course
from softloop.controller.records import CONFIG_TYPE, CYCLE, CYCLE_TYPE, GAINS_TYPE, INPUTS_TYPE, PHASE_APPROACH, PHASE_TRACK
from softloop.controller.records import STATE_TYPE as CONTROLLER_STATE_TYPE
from softloop.controller.setup import Controller, build
from softloop.controller.tick import SCRATCH_TYPE, controller_tick
from softloop.dynamics.parameters import MODEL_TYPE, Parameters
from softloop.offline.log import Log, Records
from softloop.offline.replay_log import BEGIN, RECALL, LoggedRun, Stretch, read_run
from softloop.wire.benchfile import T, load_model
from softloop.wire.errors import BadConfig, BadFile
from softloop.wire.kernel import array_of, kernel
from softloop.wire.mcap_layout import git_state, versions

Progress = Callable[[int, int], None]  # ticks done, ticks in all
Places = NDArray[np.int64]

BLOCK = 20_000  # ticks at a time: 20 MB of records
ONLY_THE_PROCESS_KNOWS = ("woken_ns", "computed_ns", "published_ns")
# Field of `ValveCommand` and where the controller takes it from.
_OF_COMMAND = {
    "tick": "tick",
    "pressure_stamp_ns": "pressure_stamp_ns",
    "inclination_stamp_ns": "inclination_stamp_ns",
    "chamber_pressure_kpa": "chamber_pressure_kpa",
    "angle_deg": "angle_deg",
    "charge_current_ma": "charge_current_ma",
    "exhaust_current_ma": "exhaust_current_ma",
    "mode": "mode",
    "ready": "inputs_valid",
}
_QUANTITIES = ("charge_current_ma", "exhaust_current_ma", "desired_pressure_kpa")
_VERSIONS = ("softloop", "numba", "numpy", "cpu")


@dataclass(frozen=True)
class Difference:
    """The first value that differs: the record's place in the log, its tick, and the field: "theta[3]", or "command.mode"."""

    record: int
    tick: int
    field: str
    logged: float
    replayed: float


@dataclass
class Deviation:
    """How far the replayed commands are from the logged ones, over the ticks that were in approach or on the trajectory."""

    ticks: int = 0
    other_mode_ticks: int = 0
    sum_of_squares: dict[str, float] = field(default_factory=lambda: dict.fromkeys(_QUANTITIES, 0.0))
    maximum: dict[str, float] = field(default_factory=lambda: dict.fromkeys(_QUANTITIES, 0.0))

    def rms(self, quantity: str) -> float:
        """Root mean square of the difference, in the quantity's unit; 0 without ticks."""
        return sqrt(self.sum_of_squares[quantity] / self.ticks) if self.ticks else 0.0

    @property
    def other_mode_share(self) -> float:
        """Part of the ticks, 0 to 1, on which the working mode is another."""
        return self.other_mode_ticks / self.ticks if self.ticks else 0.0

    def add(self, logged: Records, replayed: Records) -> None:
        active = (logged["phase"] == PHASE_APPROACH) | (logged["phase"] == PHASE_TRACK)
        if not active.any():
            return
        self.ticks += int(active.sum())
        self.other_mode_ticks += int((logged["mode"][active] != replayed["mode"][active]).sum())
        for name in _QUANTITIES:
            apart = np.abs(replayed[name][active] - logged[name][active])
            self.sum_of_squares[name] += float(np.sum(apart**2))
            self.maximum[name] = float(np.maximum(self.maximum[name], apart.max()))  # keeps a NaN, as max would not


@dataclass
class ReplayResult:
    """What a replay found.

    Attributes:
        law: of the controller that was run.
        ticks: cycle records in the log.
        compared: of these, how many were run and compared.
        commands: of these, how many have their command in the log.
        first: the first value that differs; None when all are equal.
        differing: field -> number of ticks on which it differs.
        deviation: of the commands, as `Deviation` says.
        stretches: ticks that could not be compared.
        restarts: ticks with which the controller began anew within the log.
        absent: fields of today's records that the log does not have; they were not compared, or were zero where a tick read them.
    """

    law: str
    ticks: int
    compared: int = 0
    commands: int = 0
    first: Difference | None = None
    differing: dict[str, int] = field(default_factory=dict)
    deviation: Deviation = field(default_factory=Deviation)
    stretches: list[Stretch] = field(default_factory=list)
    restarts: list[int] = field(default_factory=list)
    absent: list[str] = field(default_factory=list)

    @property
    def equal(self) -> bool:
        return self.first is None

    def note(self, name: str, records: Places, ticks: NDArray[Any], logged: NDArray[Any], replayed: NDArray[Any]) -> None:
        """Compare one field, (n,) or (n, places), of the ticks whose records stand at `records` in the log."""
        differs = _bits_differ(logged, replayed)
        if not differs.any():
            return
        rows = differs if differs.ndim == 1 else differs.any(axis=1)
        self.differing[name] = self.differing.get(name, 0) + int(rows.sum())
        row = int(np.argmax(rows))
        if self.first is not None and self.first.record <= records[row]:
            return
        place = int(np.argmax(differs[row])) if differs.ndim > 1 else None
        at = row if place is None else (row, place)
        shown = name if place is None else f"{name}[{place}]"
        self.first = Difference(int(records[row]), int(ticks[row]), shown, logged[at].item(), replayed[at].item())


@kernel(
    types.void(
        CONFIG_TYPE, MODEL_TYPE, GAINS_TYPE, array_of(types.f8), array_of(types.f8, 2), array_of(INPUTS_TYPE),
        array_of(types.u1), types.i8, array_of(CYCLE_TYPE), array_of(CONTROLLER_STATE_TYPE), array_of(CONTROLLER_STATE_TYPE),
        SCRATCH_TYPE, STEP1_TYPE, array_of(CYCLE_TYPE),
    )
)  # fmt: skip
def replay_ticks(
    config: Any, model: Any, gains: Any, knots: np.ndarray, table: np.ndarray, inputs: np.ndarray,
    action: np.ndarray, only_course: int, logged: np.ndarray, fresh: np.ndarray, state: np.ndarray,
    scratch: Any, first: Any, replayed: np.ndarray,
) -> None:  # fmt: skip
    """Run the ticks of `inputs`, as `action` says; fills `replayed`, where nothing is taken over from `logged`, and `state`.

    With `only_course` what belongs to the law stays when the state is taken over: `logged` is another law's.
    """
    for k in range(inputs.size):
        if action[k] == RECALL:
            if only_course:
                recall_course(config, knots, table, logged[k], state[0], scratch)
            else:
                recall(config, knots, table, logged[k], state[0], scratch)
            continue
        if action[k] == BEGIN:
            state[0] = fresh[0]
        controller_tick(config, model, gains, knots, table, inputs[k], state[0], scratch, first, replayed[k])


def replay(log: Log, controller_config: ControllerConfig | None = None, progress: Progress | None = None) -> ReplayResult:
    """Run the log's inputs through the controller of the log, or through another one, and compare.

    Args:
        log: of a run with a controller, its bench file and parameters attached.
        controller_config: another controller; it uses the parameters that it names, the log's own those in the log.
        progress: called with the ticks done and the ticks in all.

    Raises:
        BadFile: the log holds no ticks, no tick that can be compared, or not what is needed to build its controller.
        BadConfig: a bench file is wrong, or the other controller follows a pressure and the log's an angle, or the reverse.
    """
    run = read_run(log)
    own = logged_controller(log)
    asked = controller_config or own
    if (asked.law == "pressure") != (own.law == "pressure"):
        raise BadConfig(f"law '{asked.law}' cannot answer a log of law '{own.law}': one follows a pressure, one an angle")
    built = build(own, logged_parameters(log)) if controller_config is None else build(controller_config)
    result = ReplayResult(asked.law, len(run.cycles))
    result.stretches, result.restarts, result.absent = run.stretches, run.restarts, run.absent
    _replay_blocks(run, built, result, other=controller_config is not None, progress=progress or _silent)
    if not result.compared:
        raise BadFile(f"{log.path}: none of its {result.ticks} ticks can be compared: {result.stretches[0].why}")
    return result


def _silent(done: int, total: int) -> None:
    """No progress is shown."""


def _replay_blocks(run: LoggedRun, built: Controller, result: ReplayResult, *, other: bool, progress: Progress) -> None:
    fresh = built.state.copy()
    if other and run.action[0] == RECALL:  # where the run is at, from the log; the parameters stay the other controller's
        _run_block(run, built, slice(0, 1), fresh, only_course=False)
        built.state["theta"] = fresh["theta"]
    for start in range(0, len(run.cycles), BLOCK):
        part = slice(start, start + BLOCK)
        replayed = _run_block(run, built, part, fresh, only_course=other)
        _compare_block(run, part, replayed, result)
        progress(min(start + BLOCK, len(run.cycles)), len(run.cycles))


def _run_block(run: LoggedRun, built: Controller, part: slice, fresh: Records, *, only_course: bool) -> Records:
    replayed = np.zeros(len(run.cycles[part]), CYCLE)
    replay_ticks(
        built.config[0], built.model[0], built.gains[0], built.plan.knots, built.plan.table, run.inputs(part),
        run.action[part], int(only_course), run.cycles[part], fresh, built.state,
        built.scratch[0], built.first[0], replayed,
    )  # fmt: skip
    return replayed


def _compare_block(run: LoggedRun, part: slice, replayed: Records, result: ReplayResult) -> None:
    ran = run.action[part] != RECALL
    records = part.start + np.flatnonzero(ran)
    logged, replayed = run.cycles[part][ran], replayed[ran]
    result.compared += len(logged)
    result.deviation.add(logged, replayed)
    for name in CYCLE.names or ():
        if name not in ONLY_THE_PROCESS_KNOWS and f"cycle.{name}" not in result.absent:
            result.note(name, records, logged["tick"], logged[name], replayed[name])
    answered = run.answered[part][ran]
    result.commands += int(answered.sum())
    commands = run.commands[part][ran][answered]
    for name, source in _OF_COMMAND.items():
        if f"command.{name}" not in result.absent:
            result.note(f"command.{name}", records[answered], commands["tick"], commands[name], replayed[source][answered])


def _bits_differ(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.bool_]:
    """Elementwise; NaN equals NaN whatever its bits, and 0.0 does not equal -0.0."""
    if a.dtype.kind != "f":
        return np.asarray(a != b)
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    return (a.view(np.int64) != b.view(np.int64)) & ~(np.isnan(a) & np.isnan(b))


def logged_controller(log: Log) -> ControllerConfig:
    """`[controller]` of the bench file attached to a log. Raises BadFile or BadConfig."""
    content = _attached(log, "bench.toml").get("controller")
    if not isinstance(content, dict):
        raise BadFile(f"{log.path}: its bench file has no table [controller]: nothing to replay")
    return load_model(ControllerConfig, content, f"{log.path}: bench.toml, [controller]")


def logged_table(log: Log, name: str, kind: type[T]) -> T:
    """A table of the bench file attached to a log, with its defaults where it is not there. Raises BadFile or BadConfig."""
    return load_model(kind, _attached(log, "bench.toml").get(name, {}), f"{log.path}: bench.toml, [{name}]")


def logged_parameters(log: Log) -> Parameters:
    """The parameter file attached to a log. Raises BadFile or BadConfig."""
    return load_model(Parameters, _attached(log, "parameters.toml"), f"{log.path}: parameters.toml")


def _attached(log: Log, name: str) -> dict[str, Any]:
    if name not in log.attachments:
        raise BadFile(f"{log.path}: cannot be replayed: it has no {name} attached")
    try:
        return tomllib.loads(log.attachments[name].decode())
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise BadFile(f"{log.path}: {name}: not valid TOML: {error}") from None


def installation_differences(log: Log) -> list[str]:
    """What bears on bit equality and is another here than where the log was made, one line each."""
    logged, here = log.table("versions.json"), versions()
    found = [f"{n}: log {logged.get(n, 'unknown')}, here {here[n]}" for n in _VERSIONS if logged.get(n) != here[n]]
    commit, own_commit = _commit(log.table("git.json")), _commit(git_state(Path(__file__).resolve().parent))
    if commit and own_commit and commit != own_commit:
        found.append(f"commit: log {commit}, here {own_commit}")
    return found


def _commit(state: dict[str, Any]) -> str:
    commit = state.get("commit")
    return f"{str(commit)[:12]}{' with changes' if state.get('dirty') else ''}" if commit else ""
