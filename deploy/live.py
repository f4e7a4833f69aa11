"""What a person sees while a rig runs: a live panel on a terminal, else a plain line every few seconds."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol

from rich.columns import Columns
from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from softloop.deploy.rig_state import GATES, OUTPUTS, PHASES, RigState

PLAIN_EVERY_NS = 5_000_000_000
EVENTS_SHOWN = 5


class View(Protocol):
    """Something that shows a running rig. `stage` is a word on what the launcher does now."""

    def show(self, stage: str, state: RigState, alive: dict[str, str]) -> None:
        """Show the newest; called about ten times a second. `alive` is process -> what it is doing."""
        ...

    def say(self, line: str) -> None:
        """One line that stays."""
        ...

    def close(self) -> None:
        """Give the terminal back."""
        ...


def make_view(trajectory_s: float, *, quiet: bool) -> View:
    """The view that fits standard output."""
    if quiet:
        return Quiet()
    return LiveView(trajectory_s) if sys.stdout.isatty() else PlainView(trajectory_s)


class Quiet:
    """Shows nothing."""

    def show(self, stage: str, state: RigState, alive: dict[str, str]) -> None:
        pass

    def say(self, line: str) -> None:
        pass

    def close(self) -> None:
        pass


class PlainView:
    """A line at each new stage and every few seconds, for logs and pipes."""

    def __init__(self, trajectory_s: float, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self._trajectory_s = trajectory_s
        self._now_ns = now_ns
        self._next_ns = 0
        self._stage = ""

    def show(self, stage: str, state: RigState, alive: dict[str, str]) -> None:
        now_ns = self._now_ns()
        if now_ns >= self._next_ns or stage != self._stage:
            self._stage, self._next_ns = stage, now_ns + PLAIN_EVERY_NS
            self.say(plain_line(stage, state, self._trajectory_s))

    def say(self, line: str) -> None:
        print(line, flush=True)

    def close(self) -> None:
        pass


def plain_line(stage: str, state: RigState, trajectory_s: float) -> str:
    """The rig in one line."""
    parts = [stage]
    cycle = state.cycle
    if cycle is not None:
        parts += [f"{phase_of(state)} {state.trajectory_s:.1f}/{trajectory_s:.1f} s", f"angle {cycle.angle_deg:.2f} deg"]
        parts += [f"reference {cycle.reference_deg:.2f}", f"error {cycle.error_deg:+.2f}"]
    if state.pressure is not None:
        parts.append(f"chamber {state.pressure.chamber_pressure_kpa:.1f} kPa")
    parts.append(f"gate {gate_of(state)}")
    return ", ".join(parts)


def phase_of(state: RigState) -> str:
    return "-" if state.cycle is None else PHASES.get(state.cycle.phase, str(state.cycle.phase))


def gate_of(state: RigState) -> str:
    """The gate in words, with its reason unless it is armed."""
    if state.valves is None:
        return "silent"
    word = f"{GATES.get(state.valves.gate, '?')}, output {OUTPUTS.get(state.valves.output, '?')}"
    return word if state.reason == "none" else f"{word} ({state.reason})"


class LiveView:
    """A panel that is drawn anew in place."""

    def __init__(self, trajectory_s: float) -> None:
        self._trajectory_s = trajectory_s
        self._events: deque[str] = deque(maxlen=EVENTS_SHOWN)
        self._live = Live(console=Console(), auto_refresh=False, transient=True)
        self._live.start()

    def show(self, stage: str, state: RigState, alive: dict[str, str]) -> None:
        self._live.update(panel(stage, state, alive, self._trajectory_s, list(self._events)), refresh=True)

    def say(self, line: str) -> None:
        self._events.append(line)

    def close(self) -> None:
        self._live.stop()


def panel(stage: str, state: RigState, alive: dict[str, str], trajectory_s: float, events: list[str]) -> Any:
    """The whole picture, as a rich renderable."""
    parts = [_bar(state, trajectory_s), _values(state), _processes(state, alive)]
    return Panel(Group(*parts, *(Text(line, style="dim") for line in events)), title=f"softloop: {stage}", title_align="left")


def _bar(state: RigState, trajectory_s: float) -> Any:
    total_s = max(trajectory_s, 1e-9)
    text = Text(f"{phase_of(state):<9}{state.trajectory_s:6.1f} of {trajectory_s:.1f} s")
    return Columns([text, ProgressBar(total=total_s, completed=min(state.trajectory_s, total_s), width=50)])


def _values(state: RigState) -> Any:
    grid = Table.grid(padding=(0, 2))
    cycle, pressure = state.cycle, state.pressure
    if cycle is not None:
        error = Text(f"{cycle.error_deg:+.2f} deg", style="red" if abs(cycle.error_deg) > 5.0 else "green")
        grid.add_row("angle", f"{cycle.angle_deg:.2f} deg", "reference", f"{cycle.reference_deg:.2f} deg", "error", error)
        currents = f"{cycle.charge_applied_ma:.1f} / {cycle.exhaust_applied_ma:.1f} mA"
        grid.add_row("charge / exhaust", currents, "ticks skipped", str(cycle.skipped_total), "", "")
    if pressure is not None:
        chamber, supply = f"{pressure.chamber_pressure_kpa:.1f} kPa", f"{pressure.supply_pressure_kpa:.1f} kPa"
        grid.add_row("chamber", chamber, "supply", supply, "", "")
    grid.add_row("gate", Text(gate_of(state), style="green" if state.armed else "yellow"))
    return grid


def _processes(state: RigState, alive: dict[str, str]) -> Any:
    grid = Table.grid(padding=(0, 2))
    for name, word in alive.items():
        status = state.statuses.get(name)
        if status is None:
            grid.add_row(name, word)
            continue
        late = f"late at most {status.late_max_ns * 1e-6:.2f} ms"
        grid.add_row(name, word, f"pid {status.pid}", late, f"skipped {status.skipped}", f"dropped {status.dropped}")
    return grid
