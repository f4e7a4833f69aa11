"""`softloop run`: start the processes of a bench, arm, watch, vent, stop, and say how it went."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, Self

from softloop.deploy.bench import Bench, folders_of, load_bench
from softloop.deploy.beside import beside, onlookers
from softloop.deploy.children import Child, Children
from softloop.deploy.conclude import conclude
from softloop.deploy.fault_times import check_times
from softloop.deploy.fleet import READY, RUNNING, STOPPING, Alone, Fleet
from softloop.deploy.gate_requests import Requests, ask
from softloop.deploy.hosts import choose_host, digest, share_of
from softloop.deploy.injector import Injector
from softloop.deploy.keeper import Keeper, Kept
from softloop.deploy.launcher_events import LauncherEvents
from softloop.deploy.live import View, make_view
from softloop.deploy.meeting import Meeting
from softloop.deploy.node import KEPT_PROCESSES, STOP_ORDER, processes_of
from softloop.deploy.own_router import OwnRouter, own_router
from softloop.deploy.prepare import prepare_in_child
from softloop.deploy.progress import compile_progress
from softloop.deploy.rig_state import GATE_FAULT, RigState
from softloop.deploy.rotate import in_use, keeping_budget, make_room
from softloop.deploy.router import launcher_wire, remove_sockets
from softloop.deploy.run_dir import BENCH_FILE, bench_lock, keep_bench, keep_certificate, make_run_dir
from softloop.deploy.signals import stop_on_signals
from softloop.wire.errors import EXIT_INTERRUPTED, EXIT_LOST, EXIT_NEGATIVE, EXIT_OK, BadConfig
from softloop.wire.session import Wire
from softloop.wire.shell import Stop

POLL_S = 0.1
_DIGITS = re.compile(r"[0-9.]+")
# The gate speaks 200 times a second; a second of silence, far above any pause of a healthy machine, is a hung process.
GATE_SILENT_NS = 1_000_000_000


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
    host: str | None = None


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
    check_times(bench, bench_file)
    host, same = choose_host(bench, options.host), digest(bench, folders_of(bench_file))
    if not processes_of(bench):
        raise BadConfig(f"{bench_file}: no process to run: it has none of the tables plant, valves, controller, ...")
    with stop_on_signals() as stop, bench_lock(f"{bench.name}@{host}" if host else bench.name), ExitStack() as held:
        make_room(bench)
        run_dir = make_run_dir(bench, options.run_dir, host)
        bench = _with_options(load_bench(bench_file, run_dir), options)
        keep_bench(run_dir, bench)
        held.enter_context(in_use(run_dir))
        keep_certificate(run_dir, bench)
        with compile_progress(quiet=options.quiet) as progress:
            prepared = prepare_in_child(run_dir / BENCH_FILE, run_dir, stop, progress)
        with (
            closing(make_view(prepared.trajectory_s, quiet=options.quiet)) as view,
            keeping_budget(bench, view.say),
            own_router(bench, run_dir / BENCH_FILE, run_dir) as router,
            launcher_wire(bench, host, stop, view.say) as wire,
            closing(_fleet(bench, host, wire, same)) as fleet,
            beside(onlookers(run_dir / BENCH_FILE, options.page, options.foxglove), run_dir, view.say) as viewers,
        ):
            launch = launch_class(bench, fleet)(bench, run_dir, wire, view, stop, Children(), prepared.trajectory_s, fleet)
            outcome = launch.looking_after(viewers, router).run()
        return then(share_of(bench, host), run_dir, outcome, quiet=options.quiet)


def _fleet(bench: Bench, host: str, wire: Wire, same: int) -> Alone:
    return Fleet(bench, host, wire, same, LauncherEvents(wire).clock) if host else Alone()


def launch_class(bench: Bench, fleet: Alone) -> type[Launch]:
    """How a bench is run here: by its pace, and by whether this host leads."""
    from softloop.deploy.host_launch import FollowLaunch  # noqa: PLC0415 - they are made of what stands here
    from softloop.deploy.lockstep_launch import LockstepLaunch  # noqa: PLC0415

    return FollowLaunch if not fleet.leads else Launch if bench.pace.mode == "wall" else LockstepLaunch


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


class Launch:
    """One run of a bench, from the first process started to the last one gone."""

    def __init__(
        self,
        bench: Bench,
        run_dir: Path,
        wire: Wire,
        view: View,
        stop: Stop,
        children: Children,
        trajectory_s: float = 0.0,
        fleet: Alone | None = None,
    ) -> None:
        self.bench = bench
        self.fleet = fleet or Alone()
        self.trajectory_s = trajectory_s
        self.run_dir = run_dir
        self.wire = wire
        self.view = view
        self.stop = stop
        self.state = RigState(wire)
        self.requests = Requests(wire)
        self.children = children
        self.lost_name = ""
        self.code = EXIT_LOST
        events = LauncherEvents(wire, self.fleet.clock, None if self.fleet.leads else self.fleet.number)
        watched = bench.run.shared_router or not self.fleet.leads
        self.meeting = Meeting(wire, watched=watched, say=view.say, tell=events.router, tell_host=events.host)
        self.keeper = Keeper(view.say, events.process)
        self.words: dict[str, str] = {}
        self.all_alive = self.arm_asked = False
        self.injector = Injector(bench, run_dir, events, children, self._start_killed, self.fleet.clock)

    def looking_after(self, viewers: Iterable[Kept], router: OwnRouter | None = None) -> Self:
        """Bring back the viewers too when they die; the router is the injector's."""
        self.injector.router = router
        for kept in viewers:
            self.keeper.keep(kept, time.monotonic())
        return self

    def run(self) -> Outcome:
        """Start, arm, watch; then vent and stop, whatever happened."""
        try:
            outcome = self._until_over()
            self._show("stopping")
            self.code = outcome.code
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
            if self.fleet.has(process.name):
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
        self.fleet.say(READY)
        return self._wait_for_hosts()

    def _wait_for_hosts(self) -> Outcome | None:
        """Until nothing is missing on the bench's other hosts; says what is."""
        run = self.bench.run
        limit_s = run.hosts_wait_s + (0.0 if self.fleet.leads else run.host_silence_s)  # the host that leads is to say it first
        end_s, said = time.monotonic() + limit_s, ""
        while True:
            missing = ", ".join(self.fleet.missing())
            if not missing:
                self.fleet.say(RUNNING)
                return None
            if _DIGITS.sub("", missing) != said:  # another figure alone is no news
                said = _DIGITS.sub("", missing)
                self.view.say(f"waiting for {missing}")
            self._refresh("waiting")
            trouble = self._trouble()
            if trouble is not None:
                return trouble
            if time.monotonic() >= end_s:
                return Outcome(EXIT_LOST, f"not there after {limit_s:g} s: {missing}")
            self.stop.wait(POLL_S)

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
        self.arm_asked = True
        limit = self.bench.run.arm_timeout_s
        armed = ask(self.requests, self.state, "arm", limit, give_up=lambda: self._trouble() is not None, on_event=self.view.say)
        if armed:
            return None
        refused = Outcome(EXIT_NEGATIVE, f"the gate was not armed within {limit:g} s: {self._words_of_gate()}")
        return self._trouble() or refused

    def _words_of_gate(self) -> str:
        """What the gate said last, here or on the wire."""
        child = self.children.all.get("valves")
        return (child.last_line() if child is not None else "") or self.state.reason

    def _watch(self) -> Outcome:
        """Until the controller is done, the time is over, or something went wrong."""
        began = time.monotonic()
        duration_s = self.bench.run.duration_s
        while True:
            self._refresh("running")
            trouble = self._trouble()
            if trouble is not None:
                return trouble
            if self.state.done and not (self.meeting.excuses or self.meeting.awaits_arming):
                return Outcome(EXIT_OK, "the trajectory is done")
            if duration_s and time.monotonic() - began >= duration_s and not self.meeting.excuses:
                return Outcome(EXIT_OK, f"ended after {duration_s:g} s as asked")
            self.stop.wait(POLL_S)

    def _trouble(self) -> Outcome | None:
        """Why the run cannot go on, or None."""
        if self.stop:
            return Outcome(EXIT_INTERRUPTED, f"interrupted ({self.stop.reason})")
        ended = self.children.ended(but=self.keeper.names)
        if ended is not None:
            return self._lost(ended)
        elsewhere = self._without_router() or self._of_fleet()
        if elsewhere is not None:
            return elsewhere
        if self.state.gate == GATE_FAULT and self.meeting.fault_counts(self.fleet.judged_s):
            return Outcome(EXIT_NEGATIVE, f"the gate went to FAULT: {self.state.reason}")
        if self.meeting.excuses:
            return None
        if self._gate_is_silent():
            return Outcome(EXIT_LOST, "process 'valves' is silent: nothing heard from the gate for a second")
        return None

    def _gate_is_silent(self) -> bool:
        """Nothing has come from it for a second; what came while this launcher did something else counts."""
        if self.state.valves is None or time.monotonic_ns() - self.state.valves_heard_ns <= GATE_SILENT_NS:
            return False
        for line in self.state.refresh():
            self.view.say(line)
        return time.monotonic_ns() - self.state.valves_heard_ns > GATE_SILENT_NS

    def _without_router(self) -> Outcome | None:
        run = self.bench.run
        limit_s = run.router_wait_s if run.shared_router else run.host_silence_s
        if self.meeting.away_s <= limit_s:
            return None
        return Outcome(
            EXIT_LOST, f"the meeting point {self.bench.zenoh.meeting_point(self.bench.name)} is gone for {limit_s:g} s"
        )

    def _of_fleet(self) -> Outcome | None:
        """Why the run cannot go on, as far as other hosts are concerned."""
        ending = self.fleet.trouble(excused=self.meeting.excuses_hosts)
        return None if ending is None else Outcome(*ending)

    def _lost(self, child: Child) -> Outcome:
        self.lost_name = child.name
        self.words[child.name] = "ended"
        return Outcome(EXIT_LOST if self.all_alive else child.exit_code_for_a_person(), child.epitaph())

    def _vented(self, outcome: Outcome) -> Outcome:
        """Disarm, or FAULT for what was lost, and wait until the chamber's pressure is gone, or not much longer."""
        lost = outcome.code == EXIT_LOST
        if not (self.state.was_armed or (self.arm_asked and lost)):  # the gate has vented by itself all the time
            return outcome
        deadline = time.monotonic() + self.bench.run.vent_timeout_s
        while time.monotonic() < deadline and not self._is_vented(lost=lost):
            self.requests.send("stop" if lost else "disarm")
            self._refresh("venting")
            time.sleep(POLL_S)
        if self._is_vented(lost=lost):
            return outcome
        pressure = self.state.pressure
        left = "unknown" if pressure is None else f"{pressure.chamber_pressure_kpa:.1f} kPa"
        code = EXIT_LOST if outcome.code == EXIT_OK and self._gate_is_silent() else outcome.code
        return replace(outcome, code=code, text=f"{outcome.text}; the chamber was not vented in time, pressure {left}")

    def _is_vented(self, *, lost: bool) -> bool:
        at_rest = self.state.gate == GATE_FAULT if lost else not self.state.armed
        return at_rest and self.state.vented(self.bench.run.vented_kpa)

    def _stop_children(self) -> None:
        limit_s = self.bench.run.stop_timeout_s
        try:
            self.fleet.say(STOPPING, self.code)
            for child in self.children.stop(STOP_ORDER, limit_s, lambda group: self.fleet.await_gone(group, limit_s)):
                self.view.say(f"process '{child.name}' did not end in {self.bench.run.stop_timeout_s:g} s and was killed")
            self.fleet.linger(2 * limit_s)
        finally:
            self.children.close()
            for child in self.children.all.values():
                remove_sockets(self.bench, child.pid)

    def _refresh(self, stage: str) -> None:
        for line in self.state.refresh():
            self.view.say(line)
        self.meeting.look(self.state.reason if self.state.gate == GATE_FAULT else None, self.fleet.quiet())
        self.fleet.look()
        self.injector.act(self.state, there=self.meeting.away_s == 0.0)
        self.keeper.look(time.monotonic())
        self._show(stage)

    def _show(self, stage: str) -> None:
        self.view.show(stage, self.state, self.words)
