"""`softloop top`: a running bench in the terminal, and how busy its processes keep the machine."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from softloop.watch.overview import Lane, Overview
from softloop.wire.channels import CAN
from softloop.wire.messages import names_of

SILENT_S = 1.0
CPU_EVERY_S = 1.0
SLOW_SHARE = 0.9  # of its declared rate
_STATES = names_of("ProcessStatus", "STATE_")
_PHASES = names_of("CycleRecord", "PHASE_")
_GATES = names_of("ValveStatus", "GATE_")
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class CpuMeter:
    """Processor time of processes on this machine, from one look to the next."""

    def __init__(self, proc: Path = Path("/proc")) -> None:
        self._proc = proc
        self._before: dict[int, tuple[float, float]] = {}
        self._percent: dict[int, float | None] = {}

    def percent(self, pid: int, now_s: float | None = None) -> float | None:
        """Share of one core, measured anew every `CPU_EVERY_S`; None at first, and where it cannot be read."""
        now_s = time.monotonic() if now_s is None else now_s
        before = self._before.get(pid)
        if before is None or now_s - before[0] >= CPU_EVERY_S:
            used_s = self._used_s(pid)
            known = before is not None and used_s is not None
            self._percent[pid] = 100.0 * (used_s - before[1]) / (now_s - before[0]) if known else None  # type: ignore[operator,index]
            self._before[pid] = (now_s, used_s or 0.0)
        return self._percent[pid]

    def _used_s(self, pid: int) -> float | None:
        try:
            text = (self._proc / str(pid) / "stat").read_text()
            fields = text.rsplit(")", 1)[1].split()  # the name in brackets may hold anything
            return (int(fields[11]) + int(fields[12])) / _TICKS_PER_S
        except (OSError, IndexError, ValueError):
            return None


def screen(overview: Overview, cpu: CpuMeter, now_s: float) -> Any:
    """The whole picture, as a rich renderable."""
    return Group(headline(overview), _channels(overview, now_s), _buses(overview), _processes(overview, cpu, now_s))


def headline(overview: Overview) -> Text:
    """Gate, phase, input ages and tick lateness in one line."""
    valves, cycle = overview.valves, overview.cycle
    parts = [f"gate {'silent' if valves is None else _GATES.get(valves.gate, '?')}"]
    if cycle is not None:
        ages = f"pressure {cycle.pressure_age_ns * 1e-6:.1f} ms, inclination {cycle.inclination_age_ns * 1e-6:.1f} ms"
        parts += [f"phase {_PHASES.get(cycle.phase, '?')}", f"input ages: {ages}", f"ticks skipped {cycle.skipped_total}"]
    late = overview.lateness_spread_us()
    if late:
        parts.append("tick lateness " + ", ".join(f"{name} {value * 1e-3:.2f}" for name, value in late.items()) + " ms")
    return Text("; ".join(parts))


def _channels(overview: Overview, now_s: float) -> Table:
    table = _table("channel", ("rate (Hz)", "declared", "messages", "missing", "heard (s ago)"))
    for name, lane in sorted((full_key.split("/", 2)[2], lane) for full_key, lane in overview.lanes.items()):
        declared = 0.0 if lane.channel is CAN else lane.channel.rate_hz
        style = "yellow" if _is_slow(lane, declared, now_s) else None
        missing = "" if lane.seq == 0 else str(lane.missing)
        cells = [f"{lane.rate_hz:.1f}", f"{declared:g}" if declared else "", str(lane.count), missing]
        table.add_row(name, *cells, f"{max(0.0, now_s - lane.heard_s):.1f}", style=style)
    return table


def _is_slow(lane: Lane, declared_hz: float, now_s: float) -> bool:
    silent = now_s - lane.heard_s > SILENT_S + (1.0 / declared_hz if declared_hz else 0.0)
    return declared_hz > 0 and (silent or (declared_hz > 10 and lane.rate_hz < SLOW_SHARE * declared_hz))


def _buses(overview: Overview) -> Table:
    table = _table("CAN bus", ("load (%)", "bit/s", "emulated"))
    for name, bus in overview.buses.items():
        table.add_row(name, f"{bus.load_percent:.1f}", str(bus.bitrate), bus.words)
    return table


def _processes(overview: Overview, cpu: CpuMeter, now_s: float) -> Table:
    table = _table(
        "process", ("state", "pid", "CPU (%)", "late at most (ms)", "skipped", "dropped", "real time", "heard (s ago)")
    )
    for name, (status, heard_s) in sorted(overview.statuses.items()):
        percent = cpu.percent(status.pid, now_s) if status.pid else None
        cells = [_STATES.get(status.state, "?"), str(status.pid), "" if percent is None else f"{percent:.0f}"]
        cells += [
            f"{status.late_max_ns * 1e-6:.2f}",
            str(status.skipped),
            str(status.dropped),
            "yes" if status.realtime else "no",
        ]
        silent = now_s - heard_s > 2 * SILENT_S
        table.add_row(name, *cells, f"{max(0.0, now_s - heard_s):.1f}", style="yellow" if silent else None)
    return table


def _table(first: str, others: tuple[str, ...]) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False)
    table.add_column(first, min_width=16)
    for title in others:
        table.add_column(title, justify="right")
    return table
