"""One run of a bench in this process, at the speed of the batch, that leaves a run directory as `softloop run` does."""

from __future__ import annotations

from pathlib import Path

from softloop.deploy.bench import Bench, load_bench
from softloop.deploy.conclude import conclude
from softloop.deploy.prepare import prepare
from softloop.deploy.progress import compile_progress
from softloop.deploy.run_dir import BENCH_FILE, keep_bench, make_run_dir
from softloop.deploy.same import trace_of
from softloop.devices.gate import GATE_FAULT
from softloop.offline.closed_loop import Trace
from softloop.offline.trace_log import write_trace
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK, BadConfig
from softloop.wire.mcap_layout import attachments_of
from softloop.wire.messages import names_of


def run_here(bench_file: Path, asked: Path | None, *, report: bool, quiet: bool) -> int:
    """Run, write the log, summary and (with `report`) the page; returns the exit code, EXIT_NEGATIVE after a gate fault.

    The directory's bench file says lockstep pace: processes at that pace leave the same messages.

    Raises:
        BadFile, BadConfig: the bench file is wrong, not feasible, or no whole simulated rig.
        Unavailable: the run directory cannot be made.
    """
    run_dir = make_run_dir(load_bench(bench_file), asked)
    bench = _at_lockstep(load_bench(bench_file, run_dir), report=report)
    if bench.recorder is None:
        raise BadConfig(f"{bench_file}: key 'recorder': a run in one process leaves a log, so this table is needed")
    keep_bench(run_dir, bench)
    with compile_progress(quiet=quiet) as progress:
        prepare(load_bench(run_dir / BENCH_FILE, run_dir), run_dir, progress)
    trace = trace_of(bench)
    write_trace(run_dir / bench.recorder.file, trace, bench.name, attachments_of(run_dir))
    code, text = outcome_of(trace)
    return conclude(bench, run_dir, code, text, began=True, quiet=quiet)


def _at_lockstep(bench: Bench, *, report: bool) -> Bench:
    pace, run = bench.pace.model_copy(update={"mode": "lockstep"}), bench.run.model_copy(update={"report": report})
    return bench.model_copy(update={"pace": pace, "run": run})


def outcome_of(trace: Trace) -> tuple[int, str]:
    """Exit code and a word on how a run in one process ended."""
    faulted = trace.statuses[trace.statuses["gate"] == GATE_FAULT]
    if len(faulted):
        return EXIT_NEGATIVE, f"the gate went to FAULT: {names_of('ValveStatus', 'REASON_')[int(faulted['reason'][0])]}"
    return EXIT_OK, "the run is over, in one process"
