"""`softloop same`: whether two logs are the same run, byte by byte; or a log and the same bench in one process."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from softloop.deploy.batch import rig_tables
from softloop.deploy.bench import Bench, load_bench
from softloop.deploy.lockstep_launch import schedule_of
from softloop.deploy.run_dir import BENCH_FILE
from softloop.offline.closed_loop import Trace, ready_controller, simulate_trace
from softloop.offline.log import Log
from softloop.offline.run_log import open_run
from softloop.offline.same import Apart, compare, differences, series_of
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK, BadConfig


def same_runs(first: Path, second: Path | None, *, as_json: bool) -> int:
    """Compare two runs, or one with the batch, and say what was found.

    Returns:
        EXIT_NEGATIVE when they differ.

    Raises:
        BadFile, BadConfig: a log or its bench cannot be read, or its run was not at lockstep pace.
    """
    log = open_run(first)
    if second is None:
        trace = trace_of(load_bench(log.path.parent / BENCH_FILE, log.path.parent))
        found, messages, series = differences_from_batch(log, trace), _count(trace), len(vars(trace))
    else:
        found, of_log = differences(log, open_run(second)), series_of(log)
        messages, series = sum(len(records) for records in of_log.values()), len(of_log)
    if as_json:
        print(json.dumps({"same": not found, "differences": [asdict(apart) for apart in found]}, indent=2))
    elif found:
        print("\n".join(f"different: {apart}" for apart in found))
    else:
        print(f"the same run: {messages} messages in {series} series, byte by byte")
    return EXIT_NEGATIVE if found else EXIT_OK


def trace_of(bench: Bench) -> Trace:
    """What a bench leaves at lockstep pace, computed in this process. Raises BadFile or BadConfig."""
    if bench.pace.mode != "lockstep":
        raise BadConfig(f"bench '{bench.name}': its run was not at lockstep pace, and only such a run can be made again")
    tables = rig_tables(bench)
    built = ready_controller(tables.controller)
    return simulate_trace(tables, schedule_of(bench, built.plan.duration_s), built)


def differences_from_batch(log: Log, trace: Trace) -> list[Apart]:
    """The first difference of each channel between a lockstep log and the batch."""
    pairs = {
        "cycle": trace.cycles,
        "truth": trace.truths,
        "valves": trace.statuses,
        "pressure": trace.pressures,
        "inclination": trace.inclinations,
    }
    found = [compare(name, log[name], records) for name, records in pairs.items()]
    return [apart for apart in found if apart is not None]


def _count(trace: Trace) -> int:
    return sum(len(records) for records in vars(trace).values())
