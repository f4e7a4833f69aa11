"""How many simulated rigs hold 5 ms at once on this machine, on one router, and what each of them costs.

    python benchmarks/scale.py [--seconds 20] [--at-most 6] [--cores 0,1] [--json]

First a bare loop of 5 ms with real-time priority runs alone: what it leaves out, the machine takes. Then one, two, ... rigs
run side by side, each with its seven processes on T2 and the gate's budgets wide. A rig holds 5 ms when it stayed armed all
of the time and left out at most one tick in a thousand. Its run is valid evidence when, beside other things, its plant was in
time too, which is a burden of the simulation. Costs are of the processes of all rigs and of the router, while all are armed:
CPU time per second, and memory that no other process shares.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import psutil
from rich.console import Console
from rich.table import Table

from softloop.deploy.bench import shipped_benches
from softloop.deploy.doctor_ticks import tick_lateness
from softloop.wire.config import HostConfig
from softloop.wire.schedule import PERIOD_NS
from softloop.wire.shell import prefer_realtime

START_S = 120.0
LEFT_OUT = 1e-3  # of all ticks
# A stall of the machine ends no run here: it is counted instead.
BUDGETS = (
    "[valves]\nage_ticks = 16\nhold_ticks = 12\ndriver_silence_ms = 100.0\n"
    "[controller]\npressure_budget_ms = 100.0\ninclination_budget_ms = 100.0\n"
)
PROGRAM = (sys.executable, "-m", "softloop.deploy.cli")


@dataclass
class Row:
    """What a number of rigs did.

    Attributes:
        rigs, held, valid: how many there were, how many of them held 5 ms, and how many runs are valid evidence.
        ticks, skipped, faults: ticks made, ticks left out, and gate faults, of all.
        late_p99_us, late_max_us: tick lateness of the worst rig. plant_late_ms: of the worst plant.
        cores: CPU seconds per second, of all. mib: unshared memory of all.
        by_process: process -> CPU seconds per second and rig. These three are not known when a rig ended before its time.
    """

    rigs: int
    held: int
    valid: int
    ticks: int
    skipped: int
    faults: int
    late_p99_us: float
    late_max_us: float
    plant_late_ms: float
    cores: float
    mib: float
    by_process: dict[str, float]


class Rigs:
    """Some rigs in a folder, each a `softloop run`, and the router where they meet."""

    def __init__(self, folder: Path, count: int, seconds: float) -> None:
        self.folder = folder
        zenoh = f'[zenoh]\nendpoint = "unixsock-stream/{folder}/m.sock"\n'
        (folder / "router.toml").write_text(f'name = "router"\n{zenoh}')
        self.router = self._start("router", [str(folder / "router.toml")])
        self.all: list[subprocess.Popen[bytes]] = []
        for k in range(count):
            file = folder / f"r{k}.toml"
            file.write_text(
                f'base = "{shipped_benches()["sim_t2"]}"\nname = "r{k}"\n{zenoh}'
                f"[run]\nshared_router = true\nduration_s = {seconds}\n[plant]\nseed = {k + 1}\nwatchdog_ms = 100.0\n{BUDGETS}"
            )
            self.all.append(self._start(f"r{k}", [str(file), "--run-dir", str(folder / f"run{k}"), "--no-report"]))

    def _start(self, name: str, arguments: list[str]) -> subprocess.Popen[bytes]:
        command = [*PROGRAM, "router" if name == "router" else "run", *arguments]
        with (self.folder / f"{name}.txt").open("wb") as output:
            return subprocess.Popen(
                command,
                stdout=output,
                stderr=output,
                stdin=subprocess.DEVNULL,
                start_new_session=True,
                env={**os.environ, "XDG_RUNTIME_DIR": str(self.folder)},
            )

    def words(self, k: int) -> str:
        return (self.folder / f"r{k}.txt").read_text(errors="replace")

    def wait_armed(self) -> None:
        """Until each rig was armed, or has ended."""
        end_s = time.monotonic() + START_S
        for k, rig in enumerate(self.all):
            while "gate armed" not in self.words(k) and rig.poll() is None and time.monotonic() < end_s:
                time.sleep(0.1)

    def processes(self) -> dict[int, tuple[str, psutil.Process]]:
        """Pid -> name and process, of all that run now."""
        found: dict[int, tuple[str, psutil.Process]] = {}
        for popen, name in [(self.router, "router"), *((rig, "launcher") for rig in self.all)]:
            with contextlib.suppress(psutil.NoSuchProcess):
                parent = psutil.Process(popen.pid)
                found[popen.pid] = (name, parent)
                for child in parent.children(recursive=True):
                    words = child.cmdline()
                    if "node" in words:
                        found[child.pid] = (words[words.index("node") + 1], child)
        return found

    def end(self) -> None:
        """Wait for the rigs, which end by themselves; then the router. What does not end is killed."""
        for process in (*self.all, self.router):
            if process is self.router:
                process.send_signal(signal.SIGINT)
            try:
                process.wait(START_S)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()


@contextlib.contextmanager
def running(count: int, seconds: float) -> Iterator[Rigs]:
    """That many rigs, ended when the block is left."""
    with tempfile.TemporaryDirectory(prefix="sl-scale-") as folder:
        rigs = Rigs(Path(folder), count, seconds)
        try:
            yield rigs
        finally:
            rigs.end()


def spent(processes: dict[int, tuple[str, psutil.Process]]) -> dict[int, float]:
    """Pid -> CPU seconds so far."""
    found = {}
    for pid, (_, process) in processes.items():
        with contextlib.suppress(psutil.NoSuchProcess):
            times = process.cpu_times()
            found[pid] = times.user + times.system
    return found


def unshared_mib(processes: dict[int, tuple[str, psutil.Process]]) -> float:
    """Memory that would be free without these processes, MiB."""
    total = 0
    for _, process in processes.values():
        with contextlib.suppress(psutil.Error):
            total += process.memory_full_info().uss
    return total / 2**20


def bare_loop(seconds: float) -> dict[str, float]:
    """In a process of its own: the controller's loop with nothing in it, at the priority that a rig's processes have."""
    done = subprocess.run([sys.executable, __file__, "--bare", str(seconds)], stdout=subprocess.PIPE, text=True, check=True)
    found: dict[str, float] = json.loads(done.stdout)
    return found


def be_bare(seconds: float) -> None:
    """What `bare_loop` starts: one JSON object on standard output."""
    prefer_realtime("bare loop", HostConfig())
    late_ns, skipped = tick_lateness(round(seconds * 1e9 / PERIOD_NS))
    late_us = sorted(ns * 1e-3 for ns in late_ns)
    p99 = late_us[int(0.99 * (len(late_us) - 1))]
    print(json.dumps({"ticks": len(late_us), "skipped": skipped, "late_p99_us": p99, "late_max_us": late_us[-1]}))


def measure(count: int, seconds: float) -> Row:
    """Run that many rigs, and read their costs and their logs."""
    with running(count, seconds) as rigs:
        rigs.wait_armed()
        time.sleep(min(2.0, 0.2 * seconds))
        processes = rigs.processes()
        before, began_s = spent(processes), time.monotonic()
        time.sleep(0.5 * seconds)
        after, took_s = spent(processes), time.monotonic() - began_s
        mib = unshared_mib(processes)
        all_ran = all(rig.poll() is None for rig in rigs.all)
        rigs.end()
        summaries = [_summary(rigs, k) for k in range(count)]
    used = {pid: (after[pid] - before[pid]) / took_s for pid in after if pid in before}
    by_process: dict[str, float] = {}
    for pid, cores in used.items():
        name = processes[pid][0]
        by_process[name] = by_process.get(name, 0.0) + (cores if name == "router" else cores / count)
    if not all_ran:  # what is left when a rig has ended is no cost of that many
        return _row(summaries, math.nan, math.nan, {})
    return _row(summaries, sum(used.values()), mib, by_process)


def _summary(rigs: Rigs, k: int) -> dict[str, Any]:
    """A rig's figures, with its exit code; nothing else where there is no log."""
    file = rigs.folder / f"run{k}" / "summary.json"
    found: dict[str, Any] = json.loads(file.read_text()) if file.is_file() else {}
    return {**found, "exit_code": rigs.all[k].returncode}


def _row(summaries: list[dict[str, Any]], cores: float, mib: float, by_process: dict[str, float]) -> Row:
    held = [s["exit_code"] == 0 and s["ticks_skipped"] <= LEFT_OUT * s["ticks"] for s in summaries]

    def worst(key: str) -> float:
        return max((float(s[key]) for s in summaries if s.get(key) is not None), default=float("nan"))

    return Row(
        len(summaries),
        sum(held),
        sum(bool(s.get("evidence_valid")) for s in summaries),
        sum(int(s.get("ticks") or 0) for s in summaries),
        sum(int(s.get("ticks_skipped") or 0) for s in summaries),
        sum(int(s.get("gate_faults") or 0) for s in summaries),
        worst("tick_late_p99_us"),
        worst("tick_late_max_us"),
        worst("plant_late_max_ms"),
        cores,
        mib,
        by_process,
    )


def show(bare: dict[str, float], rows: list[Row]) -> None:
    """The tables for a person."""
    table = Table(title="Rigs side by side", title_justify="left")
    for head in (
        "rigs",
        "hold 5 ms",
        "valid",
        "ticks",
        "left out",
        "faults",
        "late p99 us",
        "late max us",
        "plant late ms",
        "cores",
        "cores/rig",
        "MiB/rig",
    ):
        table.add_column(head, justify="right")
    for row in rows:
        table.add_row(
            str(row.rigs), str(row.held), str(row.valid), str(row.ticks), str(row.skipped), str(row.faults),
            f"{row.late_p99_us:.0f}", f"{row.late_max_us:.0f}",
            f"{row.plant_late_ms:.1f}", f"{row.cores:.2f}", f"{row.cores / row.rigs:.2f}", f"{row.mib / row.rigs:.0f}",
        )  # fmt: skip
    console = Console(width=120)
    console.print(
        "a bare loop of 5 ms alone: {ticks:.0f} ticks, {skipped:.0f} left out, late 99 % {late_p99_us:.0f} us, "
        "most {late_max_us:.0f} us".format(**bare),
        soft_wrap=True,
        highlight=False,
    )
    console.print(table)
    each = sorted(rows[0].by_process.items(), key=lambda item: -item[1])
    console.print("one rig, cores: " + ", ".join(f"{name} {cores:.3f}" for name, cores in each))
    holding = [row.rigs for row in rows if row.held == row.rigs]
    console.print(f"{max(holding, default=0)} rigs hold 5 ms on {len(os.sched_getaffinity(0))} cores")


def main() -> None:
    """Measure one more rig each time, until none holds any more; show, and with --json print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=20.0, help="armed")
    parser.add_argument("--at-most", type=int, default=6)
    parser.add_argument("--cores", default="", help="only on these, such as 0,1")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--bare", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.bare is not None:
        be_bare(options.bare)
        return
    if options.cores:
        os.sched_setaffinity(0, {int(core) for core in options.cores.split(",")})
    bare = bare_loop(options.seconds)
    rows: list[Row] = []
    while len(rows) < options.at_most and (len(rows) < 2 or rows[-1].held or rows[-2].held):
        rows.append(measure(len(rows) + 1, options.seconds))
        print(f"{rows[-1].rigs}: {rows[-1].held} held", file=sys.stderr, flush=True)
    show(bare, rows)
    if options.json:
        print(json.dumps({"bare": bare, "rigs": [asdict(row) for row in rows]}, indent=2))


if __name__ == "__main__":
    main()
