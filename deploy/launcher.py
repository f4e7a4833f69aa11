"""`softloop run`: start the processes of a bench, arm, watch, vent, stop, and say how it went."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Literal, Self

from softloop.deploy.bench import Bench, load_bench
from softloop.deploy.beside import beside
from softloop.deploy.children import Child, Children
from softloop.deploy.conclude import conclude
from softloop.deploy.gate_requests import Requests, ask
from softloop.deploy.injector import Injector
from softloop.deploy.keeper import Keeper, Kept
from softloop.deploy.launcher_events import LauncherEvents
from softloop.deploy.live import View, make_view
from softloop.deploy.node import KEPT_PROCESSES, STOP_ORDER, processes_of
from softloop.deploy.prepare import prepare_in_child
from softloop.deploy.progress import compile_progress
from softloop.deploy.rig_state import GATE_FAULT, RigState
from softloop.deploy.rotate import in_use, keeping_budget, make_room
from softloop.deploy.router import launcher_wire, remove_sockets
from softloop.deploy.run_dir import BENCH_FILE, bench_lock, keep_bench, keep_certificate, make_run_dir
from softloop.wire.channels import HELLO
from softloop.wire.errors import EXIT_INTERRUPTED, EXIT_LOST, EXIT_NEGATIVE, EXIT_OK, BadConfig
from softloop.wire.lockstep import Lockstep
from softloop.wire.schedule import LAUNCHER_ORIGIN, Schedule, make_schedule
from softloop.wire.session import Wire
from softloop.wire.shell import Stop

POLL_S = 0.1
# The gate speaks 200 times a second; a second of silence, far above any pause of a healthy machine, is a hung process.
GATE_SILENT_NS = 1_000_000_000
AFTER_S = 0.1  # lockstep pace: from the end of the trajectory to disarming


@dataclass(frozen=True)
class Outcome:
    """How a run ended; `began` says that it came as far as an armed gate, or to a rig that needs none."""

    code: int
    text: str
    began: bool = True


@dataclass(frozen=True)
class Options:
    """What the command line may change for one run."""

    run_dir: Path | None = None
    duration_s: float | None = None
    report: bool | None = None
    quiet: bool = False
    pace: Literal["wall", "lockstep"] | None = None
    page: bool = False
    foxglove: bool = False
    certificate: Path | None = None


def _conclude(bench: Bench, run_dir: Path, outcome: Outcome, *, quiet: bool) -> int:
    return conclude(bench, run_dir, outcome.code, outcome.text, began=outcome.began, quiet=quiet)


def launch(bench_file: Path, options: Options, then: Callable[..., int] = _conclude) -> int:
    """Run a bench from start to end; returns the exit code, which `then` gives once all its processes have ended.

    Raises:
        BadFile, BadConfig: the bench file is wrong, or its trajectory not feasible.
        Unavailable: the bench runs already, its address is in use, its disk budget is used up, or the run directory cannot
            be made.
    """
    bench = _with_options(load_bench(bench_file), options)
    if not processes_of(bench):
        raise BadConfig(f"{bench_file}: no process to run: it has none of the tables plant, valves, controller, ...")
    with stop_on_signals() as stop, bench_lock(bench.name), ExitStack() as held:
        make_room(bench)
        run_dir = make_run_dir(bench, options.run_dir)
        bench = _with_options(load_bench(bench_file, run_dir), options)
        keep_bench(run_dir, bench)
        held.enter_context(in_use(run_dir))
        keep_certificate(run_dir, bench)
        with compile_progress(quiet=options.quiet) as progress:
            prepared = prepare_in_child(run_dir / BENCH_FILE, run_dir, stop, progress)
        with (
            launcher_wire(bench) as wire,
            closing(make_view(prepared.trajectory_s, quiet=options.quiet)) as view,
            keeping_budget(bench, view.say),
            beside(onlookers(run_dir, options), run_dir, view.say) as viewers,
        ):
            kind = Launch if bench.pace.mode == "wall" else LockstepLaunch
            launch = kind(bench, run_dir, wire, view, stop, Children(), prepared.trajectory_s)
            outcome = launch.looking_after(viewers).run()
        return then(bench, run_dir, outcome, quiet=options.quiet)


def onlookers(run_dir: Path, options: Options) -> list[list[str]]:
    """The commands that look at the run from outside."""
    asked = (("page", options.page), ("foxglove", options.foxglove))
    return [[name, str(run_dir / BENCH_FILE)] for name, wanted in asked if wanted]


def _with_options(bench: Bench, options: Options) -> Bench:
    """The bench with what the command line changes."""
    changed: dict[str, float | bool | str] = {}
    if options.duration_s is not None:
        changed["duration_s"] = options.duration_s
    if options.report is not None:
        changed["report"] = options.report
    if options.certificate is not None:
        changed["certificate"] = str(options.certificate)
    paced = bench.pace if options.pace is None else bench.pace.model_copy(update={"mode": options.pace})
    return bench.model_copy(update={"run": bench.run.model_copy(update=changed), "pace": paced})


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """A `Stop` that Ctrl-C, SIGTERM and a closed terminal set, instead of what they do otherwise."""
    stop = Stop()

    def on_signal(number: int, _frame: FrameType | None) -> None:
        stop.set(signal.Signals(number).name)

    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(number, on_signal) for number in numbers]
    try:
        yield stop
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


class Launch:
    """One run of a bench, from the first process started to the last one gone."""

    def __init__(
        self, bench: Bench, run_dir: Path, wire: Wire, view: View, stop: Stop, children: Children, trajectory_s: float = 0.0
    ) -> None:
        self.bench = bench
        self.trajectory_s = trajectory_s
        self.run_dir = run_dir
        self.wire = wire
        self.view = view
        self.stop = stop
        self.state = RigState(wire)
        self.requests = Requests(wire)
        self.children = children
        events = LauncherEvents(wire)
        self.keeper = Keeper(view.say, events.process)
        self.words: dict[str, str] = {}
        self.all_alive = False
        self.injector = Injector(bench, run_dir, events, children, self._start_killed)

    def looking_after(self, viewers: Iterable[Kept]) -> Self:
        """Bring back the viewers too when they die."""
        for kept in viewers:
            self.keeper.keep(kept, time.monotonic())
        return self

    def run(self) -> Outcome:
        """Start, arm, watch; then vent and stop, whatever happened."""
        try:
            outcome = self._until_over()
            self._show("stopping")
            return replace(self._vented(outcome), began=self.state.was_armed or outcome.code == EXIT_OK)
        finally:
            self._stop_children()

    def _until_over(self) -> Outcome:
        self._start()
        outcome = self._wait_alive()
        if outcome is None and self.bench.run.arm and self.bench.valves is not None:
            outcome = self._arm()
        return outcome or self._watch()

    def _start(self) -> None:
        for process in processes_of(self.bench):
            self._start_one(process.name)

    def _start_one(self, name: str) -> Child:
        """Start a process of the bench, or start it anew."""
        if name in self.children.all:  # one that was killed left its socket
            remove_sockets(self.bench, self.children.all[name].pid)
        arguments = ["node", name, str(self.run_dir / BENCH_FILE), "--run-dir", str(self.run_dir)]
        self.words[name] = "starting"
        return self.children.start(name, arguments, self.run_dir / f"{name}.log")

    def _start_killed(self, name: str) -> None:
        """After an injection; what is kept anyway comes back by itself."""
        if name not in self.keeper.names:
            self._start_one(name)

    def _wait_alive(self) -> Outcome | None:
        deadline = time.monotonic() + self.bench.run.ready_timeout_s
        missing = set(self.words)
        while missing and time.monotonic() < deadline:
            alive = self.wire.processes_alive(timeout_s=POLL_S)
            missing -= alive
            self.words.update(dict.fromkeys(alive & set(self.words), "alive"))
            self._refresh("starting")
            trouble = self._trouble()
            if trouble is not None:
                return trouble
            self.stop.wait(POLL_S)
        if missing:
            limit = self.bench.run.ready_timeout_s
            return Outcome(EXIT_LOST, f"not alive after {limit:g} s: {self._last_words(missing)}; see the logs in {self.run_dir}")
        self.all_alive = True
        self._keep_listeners()
        return None

    def _keep_listeners(self) -> None:
        """From now on those that only listen are brought back when they die. At lockstep pace none is: all wait for all."""
        for name in KEPT_PROCESSES:
            if name in self.children.all:
                kept = Kept(self.children.all[name], partial(self._start_one, name), partial(self._is_alive, name), needed=True)
                self.keeper.keep(kept, time.monotonic())

    def _is_alive(self, name: str) -> bool:
        alive = name in self.wire.processes_alive(timeout_s=POLL_S)
        self.words[name] = "alive" if alive else self.words[name]
        return alive

    def _last_words(self, names: set[str]) -> str:
        said = {name: self.children.all[name].last_line() for name in sorted(names)}
        return ", ".join(f"{name} ({line})" if line else name for name, line in said.items())

    def _arm(self) -> Outcome | None:
        self.stop.wait(self.bench.run.settle_s)
        limit = self.bench.run.arm_timeout_s
        armed = ask(self.requests, self.state, "arm", limit, give_up=lambda: self._trouble() is not None, on_event=self.view.say)
        if armed:
            return None
        said = self.children.all["valves"].last_line()
        refused = Outcome(EXIT_NEGATIVE, f"the gate was not armed within {limit:g} s: {said or self.state.reason}")
        return self._trouble() or refused

    def _watch(self) -> Outcome:
        """Until the controller is done, the time is over, or something went wrong."""
        began = time.monotonic()
        duration_s = self.bench.run.duration_s
        while True:
            self._refresh("running")
            trouble = self._trouble()
            if trouble is not None:
                return trouble
            if self.state.done:
                return Outcome(EXIT_OK, "the trajectory is done")
            if duration_s and time.monotonic() - began >= duration_s:
                return Outcome(EXIT_OK, f"ended after {duration_s:g} s as asked")
            self.stop.wait(POLL_S)

    def _trouble(self) -> Outcome | None:
        """Why the run cannot go on, or None."""
        if self.stop:
            return Outcome(EXIT_INTERRUPTED, f"interrupted ({self.stop.reason})")
        ended = self.children.ended(but=self.keeper.names)
        if ended is not None:
            return self._lost(ended)
        if self.state.gate == GATE_FAULT:
            return Outcome(EXIT_NEGATIVE, f"the gate went to FAULT: {self.state.reason}")
        if self.state.valves is not None and time.monotonic_ns() - self.state.valves_heard_ns > GATE_SILENT_NS:
            return Outcome(EXIT_LOST, "process 'valves' is silent: nothing heard from the gate for a second")
        return None

    def _lost(self, child: Child) -> Outcome:
        self.words[child.name] = "ended"
        return Outcome(EXIT_LOST if self.all_alive else child.exit_code_for_a_person(), child.epitaph())

    def _vented(self, outcome: Outcome) -> Outcome:
        """Disarm and wait until the chamber's pressure is gone, or not much longer."""
        if not self.state.was_armed:  # the gate has vented by itself all the time
            return outcome
        deadline = time.monotonic() + self.bench.run.vent_timeout_s
        while time.monotonic() < deadline and not self._is_vented():
            self.requests.send("disarm")
            self._refresh("venting")
            time.sleep(POLL_S)
        if self._is_vented():
            return outcome
        pressure = self.state.pressure
        left = "unknown" if pressure is None else f"{pressure.chamber_pressure_kpa:.1f} kPa"
        return replace(outcome, text=f"{outcome.text}; the chamber was not vented in time, pressure {left}")

    def _is_vented(self) -> bool:
        return not self.state.armed and self.state.vented(self.bench.run.vented_kpa)

    def _stop_children(self) -> None:
        try:
            for child in self.children.stop(STOP_ORDER, self.bench.run.stop_timeout_s):
                self.view.say(f"process '{child.name}' did not end in {self.bench.run.stop_timeout_s:g} s and was killed")
        finally:
            self.children.close()
            for child in self.children.all.values():
                remove_sockets(self.bench, child.pid)

    def _refresh(self, stage: str) -> None:
        for line in self.state.refresh():
            self.view.say(line)
        self.injector.act(self.state)
        self.keeper.look(time.monotonic())
        self._show(stage)

    def _show(self, stage: str) -> None:
        self.view.show(stage, self.state, self.words)


class LockstepLaunch(Launch):
    """A run at lockstep pace: planned beforehand, tick by tick, and over when the plant has taken the last one."""

    def _keep_listeners(self) -> None:
        pass

    def _until_over(self) -> Outcome:
        self._start()
        return self._wait_alive() or self._conduct() or self._watch_ticks()

    def _conduct(self) -> Outcome | None:
        """Hand the gate its requests beforehand, and give the word to begin."""
        schedule = schedule_of(self.bench, self.trajectory_s)
        pace = Lockstep(self.bench.pace, self.wire, self.stop, set(self.words))
        pace.meet(pace.others, None)
        requests = Requests(self.wire, LAUNCHER_ORIGIN)
        if self.bench.run.arm:
            requests.send("arm", schedule.arm_ns)
            requests.send("disarm", schedule.disarm_ns)
            pace.board.wait(
                lambda: pace.board.present["valves"].requests >= 2, lambda: "'valves', which has two requests to take"
            )
        pace.board.wait(lambda: pace.board.tick is not None, lambda: "'plant'", lambda: pace.say(HELLO, ticks=schedule.ticks))
        return self._trouble()

    def _watch_ticks(self) -> Outcome:
        while True:
            self._refresh("running")
            trouble = self._trouble()
            if trouble is not None:
                return trouble
            if all(child.exit_code() == EXIT_OK for name, child in self.children.all.items() if name != "recorder"):
                return self._over()
            self.stop.wait(POLL_S)

    def _over(self) -> Outcome:
        self._refresh("running")
        if self.state.gate == GATE_FAULT:
            return Outcome(EXIT_NEGATIVE, f"the gate went to FAULT: {self.state.reason}")
        if self.bench.run.arm and not self.state.was_armed:
            return Outcome(EXIT_NEGATIVE, f"the gate was not armed: {self.children.all['valves'].last_line()}")
        return Outcome(EXIT_OK, "the run is over, tick by tick")

    def _trouble(self) -> Outcome | None:
        if self.stop:
            return Outcome(EXIT_INTERRUPTED, f"interrupted ({self.stop.reason})")
        lost = next((c for c in self.children.all.values() if c.exit_code() not in (None, EXIT_OK)), None)
        return None if lost is None else self._lost(lost)

    def _vented(self, outcome: Outcome) -> Outcome:
        return outcome  # venting is part of the plan


def schedule_of(bench: Bench, trajectory_s: float) -> Schedule:
    """The plan of a run: settle, arm, follow the trajectory (or `[run] duration_s`), disarm, vent."""
    approach_s = bench.controller.approach_s if bench.controller is not None else 0.0
    armed_s = bench.run.duration_s or approach_s + trajectory_s + AFTER_S
    return make_schedule(bench.run.settle_s, armed_s, bench.run.vent_timeout_s)
