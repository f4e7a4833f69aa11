"""How fast is the closed loop in one process? Times real time per core (CPU time, best of several runs) on the rig layer.

With it where the time goes, scipy's `solve_ivp` closing the same loop for a ratio, two processes against one (and two threads),
and a cold start. The machine's load is printed, as it spoils all of these.

    python benchmarks/batch.py [--bench sim] [--quick]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from logged_currents import Currents
from plant_speed import loop as run_plant_alone
from scipy_loop import scipy_loop

from softloop.controller.records import ANGLE_LAWS
from softloop.deploy.batch import rig_tables
from softloop.deploy.bench import find_bench, load_bench
from softloop.offline.campaign import Case, controller_for, plan_cases, run_cases
from softloop.offline.closed_loop import SETTLE_S, RigTables, simulate_tables, simulate_trace
from softloop.offline.pools import chunks, run_here, run_in_processes
from softloop.offline.scores import run_scores
from softloop.plant.records import EVENT
from softloop.plant.setup import new_device, new_state, plant_record
from softloop.wire.schedule import PERIOD_NS, START_NS, make_schedule

TRAJECTORIES, REPEATS = ("t1", "t2"), 7
LAWS = ANGLE_LAWS  # a campaign judges angles
SCIPY_S, SCIPY_METHODS = 2.0, ("RK45", "LSODA")
JOBS_SEEDS = 60
PERIOD_S = 1e-9 * PERIOD_NS


def best_cpu_s(work: Callable[[], Any], repeats: int = REPEATS) -> float:
    """The least CPU time of several calls, after one that does not count."""
    work()
    found = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        found.append(time.process_time() - begin)
    return min(found)


def tables_for(tables: RigTables, law: str, trajectory: str) -> RigTables:
    """The bench's tables with another law and trajectory."""
    return replace(tables, controller=controller_for(tables, Case(law, trajectory, tables.plant.seed)))


def show_speed(tables: RigTables) -> None:
    """Times real time of whole runs, and of the plant alone under the currents of each."""
    print(f"rig layer, step {tables.plant.step_us} us; times real time per core")
    for law in LAWS:
        for trajectory in TRAJECTORIES:
            own = tables_for(tables, law, trajectory)
            run = simulate_tables(own)
            seconds = SETTLE_S + len(run.cycles) * PERIOD_S + 0.1
            whole, scores = best_cpu_s(lambda own=own: simulate_tables(own)), best_cpu_s(lambda run=run: run_scores(run))
            alone, steps_s = plant_alone(own, seconds)
            print(
                f"  {law:7s} {trajectory}  {seconds / whole:6.0f} x   with scores {seconds / (whole + scores):6.0f} x   "
                f"plant alone {seconds / alone:6.0f} x ({100.0 * alone / whole:.0f} % of the time, {steps_s:.0f} steps/s)"
            )


def plant_alone(tables: RigTables, seconds: float) -> tuple[float, float]:
    """CPU time of the rig alone under the currents of a run, s; and integration steps per second of rig time."""
    trace = simulate_trace(tables, make_schedule(SETTLE_S, seconds - SETTLE_S, 0.0))
    sent = trace.statuses[: len(trace.cycles)]
    charge, exhaust = sent["charge_current_ma"].copy(), sent["exhaust_current_ma"].copy()
    currents = Currents(sent["stamp_ns"] + 250_000, charge, exhaust, tables.plant, 0)
    params, events, steps = plant_record(tables.plant), np.zeros(64, EVENT), 0

    def work() -> None:
        nonlocal steps
        state = new_state(params, new_device(tables.plant), START_NS)
        run_plant_alone(params, state, currents.end_ns, currents.charge_ma, currents.exhaust_ma, events)
        steps = int(state.steps)

    return best_cpu_s(work), steps / seconds


def show_scipy(tables: RigTables) -> None:
    """Scipy closing the same loop; how far it goes apart says that it is the same."""
    for law in LAWS:
        own, schedule = tables_for(tables, law, "t1"), make_schedule(0.5, SCIPY_S - 0.5, 0.0)
        ours = best_cpu_s(lambda own=own, schedule=schedule: simulate_trace(own, schedule, all_channels=False))
        angle = simulate_trace(own, schedule, all_channels=False).truths["angle_deg"][1:]
        for method in SCIPY_METHODS:
            begin = time.process_time()
            theirs_deg = scipy_loop(own, SCIPY_S, method)
            theirs = time.process_time() - begin
            apart = np.abs(theirs_deg[: len(angle)] - angle[: len(theirs_deg)]).max()
            speed, ratio = SCIPY_S / theirs, theirs / ours
            print(f"  {law:7s} {method:6s} {speed:6.2f} x real time; this loop: {ratio:4.0f} times it; {apart:.1e} deg apart")


def show_jobs(tables: RigTables) -> None:
    """Two workers against one, by the clock on the wall: processes and threads, kernels loaded, a first round not counted."""
    cases = plan_cases(("arc",), ("t1",), range(JOBS_SEEDS), payload=False)
    rate = {1: 0.0, 2: 0.0}
    for jobs in rate:
        rate[jobs] = _steady_rate(tables, cases, jobs)
    alone = _wall_s(lambda: list(run_here(tables, cases)))
    with ThreadPoolExecutor(2) as pool:
        threads = _wall_s(lambda: list(pool.map(lambda some: run_cases(tables, some), chunks(cases))))
    print(f"  2 processes do {rate[2] / rate[1]:.2f} times the runs of 1 ({rate[1]:.1f} and {rate[2]:.1f} runs/s)")
    print(f"  2 threads   do {alone / threads:.2f} times the runs of this process alone")


def _steady_rate(tables: RigTables, cases: Sequence[Case], jobs: int) -> float:
    """Runs per second, from when each worker can have begun to the end."""
    skipped, done, begin = 4 * jobs, 0, 0.0
    for _ in run_in_processes(tables, cases, jobs):
        done += 1
        if done == skipped:
            begin = time.monotonic()
    return (done - skipped) / (time.monotonic() - begin)


def _wall_s(work: Callable[[], Any]) -> float:
    begin = time.monotonic()
    work()
    return time.monotonic() - begin


def show_start(bench: str) -> None:
    """Of the command itself for one rig: with kernels in the cache, and without any."""
    with tempfile.TemporaryDirectory(prefix="sl-batch-") as folder:
        command = [sys.executable, "-m", "softloop.deploy.cli", "batch", bench, "--seeds", "0", "--out", folder]
        empty = {**os.environ, "XDG_CACHE_HOME": str(Path(folder) / "cache")}
        for name, environment in (("kernels in the cache", None), ("everything compiled", empty)):
            begin = time.monotonic()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)
            print(f"  one rig by the command, {name}: {time.monotonic() - begin:.1f} s")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--bench", default="sim")
    parser.add_argument("--quick", action="store_true", help="only the speed of whole runs")
    options = parser.parse_args()
    tables = rig_tables(load_bench(find_bench(Path(options.bench))))
    print(f"load of the machine at the start: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    show_speed(tables)
    if not options.quick:
        print("scipy closing the same loop")
        show_scipy(tables)
        print("sharing the work")
        show_jobs(tables)
        print("cold start")
        show_start(options.bench)
    print(f"load of the machine at the end: {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
