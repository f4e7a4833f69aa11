"""What `[faults]` leaves to the launcher: processes killed, stopped, started anew, and a disk that is full for one of them."""

from __future__ import annotations

import resource
import signal
from collections.abc import Callable
from pathlib import Path

from softloop.deploy.bench import Bench
from softloop.deploy.children import Child, Children
from softloop.deploy.launcher_events import LauncherEvents
from softloop.deploy.own_router import OwnRouter
from softloop.deploy.rig_state import RigState
from softloop.wire.clock import Clock, WallClock
from softloop.wire.fault_config import LAUNCHER, InjectionConfig
from softloop.wire.faults import NUMBERS

_S = 1_000_000_000
BACK_S = 2.0  # measured: a router that is back is joined by all within that; see docs/hosts.md


class Injector:
    """Carries out the launcher's injections when the launcher looks, so up to a tenth of a second late; events say when."""

    def __init__(
        self,
        bench: Bench,
        run_dir: Path,
        events: LauncherEvents,
        children: Children,
        start: Callable[[str], None],
        clock: Clock | None = None,
    ) -> None:
        self._waiting = [injection for _, injection in bench.faults.of_process(LAUNCHER)]
        self._standing: list[InjectionConfig] = []
        self._untold: list[tuple[InjectionConfig, int, int]] = []  # what nobody could hear: (injection, came or left, when)
        self._back_ns: int | None = None
        self.router: OwnRouter | None = None
        self._children, self._start = children, start
        self._log = run_dir / bench.recorder.file if bench.recorder is not None else run_dir
        self._events = events
        self._clock = clock or WallClock()
        self._armed_ns: int | None = None

    def act(self, state: RigState, *, there: bool = True) -> None:
        """Begin and end what is due now; `there`: the meeting point is."""
        if not self._waiting and not self._standing and not self._untold:
            return
        if self._armed_ns is None and state.armed:
            self._armed_ns = int(state.valves.stamp_ns)
        if self._armed_ns is None:
            return
        since_s = (self._clock.now_ns() - self._armed_ns) / _S
        for injection in [i for i in self._waiting if i.at_s <= since_s]:
            self._waiting.remove(injection)
            if injection.family != "router" and self._alive(injection) is None:
                continue
            self._standing.append(injection)
            self._tell(injection, 1)
            self._begin(injection)
        for injection in [i for i in self._standing if i.at_s + i.duration_s <= since_s]:
            self._standing.remove(injection)
            self._end(injection)
            self._tell(injection, 0)
        self._tell_late(there=there)

    def _tell(self, injection: InjectionConfig, code: int) -> None:
        if injection.family == "router":
            self._untold.append((injection, code, self._clock.now_ns()))
        else:
            self._events.fault(NUMBERS[injection.kind], code)

    def _tell_late(self, *, there: bool) -> None:
        """Tell of a router's loss once all who listen are back behind it."""
        if not there or not any(code == 0 for _, code, _ in self._untold):
            self._back_ns = None
            return
        now_ns = self._clock.now_ns()
        self._back_ns = now_ns if self._back_ns is None else self._back_ns
        if now_ns - self._back_ns < BACK_S * _S:
            return
        for injection, code, stamp_ns in self._untold:
            self._events.fault(NUMBERS[injection.kind], code, stamp_ns)
        self._untold.clear()

    def _alive(self, injection: InjectionConfig) -> Child | None:
        """The process that it is done to; None where that is not there (any more): then nothing is done, and nothing said."""
        child = self._children.all.get(injection.target)
        return None if child is None or child.exit_code() is not None else child

    def _begin(self, injection: InjectionConfig) -> None:
        if injection.family == "router":
            if self.router is not None:
                self.router.kill()
        elif not self._set(injection, on=True):
            child = self._children.all[injection.target]
            child.popen.kill()
            child.popen.wait()
            if injection.kind == "process_restart":
                self._start(injection.target)

    def _end(self, injection: InjectionConfig) -> None:
        if injection.family == "router":
            if self.router is not None:
                self.router.start()
        elif self._alive(injection) is not None:
            self._set(injection, on=False)

    def _set(self, injection: InjectionConfig, *, on: bool) -> bool:
        """Begin or end what stands for a while; False for a kind that is done once and for all."""
        child = self._children.all[injection.target]
        if injection.kind == "process_stop":
            child.popen.send_signal(signal.SIGSTOP if on else signal.SIGCONT)
        elif injection.kind == "disk_full":
            size = self._log.stat().st_size if self._log.is_file() else 0
            _limit_files(child, size if on else resource.RLIM_INFINITY)
        else:
            return False
        return True


def _limit_files(child: Child, size: int) -> None:
    """Let a process write no file longer than `size` bytes: each write beyond it fails, as on a full disk."""
    _, hard = resource.prlimit(child.pid, resource.RLIMIT_FSIZE)
    soft = hard if size == resource.RLIM_INFINITY else size
    resource.prlimit(child.pid, resource.RLIMIT_FSIZE, (soft, hard))
