"""`softloop doctor`: accepts the computer and the devices before the rig runs, line by line, with what to do."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from softloop.deploy.bench import PROCESS_NAMES, Bench, find_bench, load_bench
from softloop.deploy.children import PROGRAM
from softloop.deploy.doctor_check import Check, worst
from softloop.deploy.doctor_clock import clock, clock_source, day_error_ms, offset
from softloop.deploy.doctor_devices import devices, is_real
from softloop.deploy.doctor_host import disk, existing, lateness, library_versions, permissions, zenoh
from softloop.deploy.doctor_identity import identities
from softloop.deploy.hosts import choose_host, shares
from softloop.deploy.prepare import prepare_in_child
from softloop.deploy.progress import compile_progress
from softloop.deploy.router import launcher_wire
from softloop.deploy.run_dir import BENCH_FILE, bench_lock, keep_bench
from softloop.deploy.signals import stop_on_signals
from softloop.wire.clock import WallClock
from softloop.wire.config import PaceConfig, ZenohConfig
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK, Interrupted, SoftloopError, Unavailable
from softloop.wire.mcap_layout import read_origin, versions

CHILD_SLACK_S = 40.0


def doctor(bench_file: Path, seconds: float, certificate: Path | None, asked: str | None, *, as_json: bool) -> int:
    """Examine, say it, and write the certificate; EXIT_NEGATIVE when something fails.

    Args:
        asked: of a bench on several hosts, which this is.

    Raises:
        BadFile, BadConfig: the bench file is wrong, or has no such host.
        Unavailable: the bench is running: a machine is examined at rest; or the certificate cannot be written.
        Interrupted: by a person, while kernels were compiled.
    """
    file = find_bench(bench_file)
    bench = load_bench(file)
    host = choose_host(bench, asked)
    lock = f"{bench.name}@{host}" if host else bench.name
    with bench_lock(lock), tempfile.TemporaryDirectory(prefix="softloop-") as folder:
        checks = examine(file, Path(folder), seconds, host)
    answer = certified(bench, checks, host)
    if certificate is not None:
        _write(certificate, answer)
    print(json.dumps(answer, indent=2) if as_json else "\n".join(lines(bench, checks)))
    return EXIT_NEGATIVE if answer["verdict"] == "fail" else EXIT_OK


def examine(bench_file: Path, run_dir: Path, seconds: float, host: str = "") -> list[Check]:
    """All checks, in the order in which they matter to a person.

    Args:
        run_dir: an empty folder, what `{run_dir}` of the bench file becomes.
        host: of a bench on several hosts, that which is looked at: its own processes, as if it were alone.

    Raises:
        Unavailable: the bench is running. Interrupted: as `doctor`.
    """
    whole = load_bench(bench_file, run_dir)
    own = shares(whole)[host] if host else PROCESS_NAMES
    bench = alone(whole)
    keep_bench(run_dir, bench)
    checks = [prepared(run_dir)]
    with launcher_wire(bench) as wire, _shown("listening to the machine"):
        checks += timing(bench, _measure_in_child(run_dir / BENCH_FILE, seconds), real=is_real(bench, own))
        checks += devices(bench, run_dir, wire, seconds, own)
    folder = existing(Path(bench.run.folder))
    clocks = [clock(clock_source(), day_error_ms()), *([offset(whole, host, seconds)] if host else [])]
    return [*checks, *identities(whole, host), *clocks, *disk(bench, folder, recorded="recorder" in own), library_versions()]


def alone(bench: Bench) -> Bench:
    """The bench with all its processes on this computer, at wall pace: what can be looked at from here."""
    changed: dict[str, Any] = {"pace": PaceConfig()}
    if bench.hosts:
        tables = {name: getattr(bench, name) for name in PROCESS_NAMES}
        changed |= {name: table.model_copy(update={"host": ""}) for name, table in tables.items() if table is not None}
        changed |= {"hosts": {}, "zenoh": ZenohConfig(lease_ms=bench.zenoh.lease_ms)}
    return bench.model_copy(update=changed)


def _shown(what: str) -> AbstractContextManager[Any]:
    return Console(stderr=True).status(what) if sys.stderr.isatty() else nullcontext()


def prepared(run_dir: Path) -> Check:
    """The bench in `run_dir` made ready as for a run: kernels compiled, parameters and trajectory good. Raises Interrupted."""
    try:
        with stop_on_signals() as stop, compile_progress(quiet=False) as progress:
            ready = prepare_in_child(run_dir / BENCH_FILE, run_dir, stop, progress)
    except Interrupted:
        raise
    except SoftloopError as error:
        return Check("bench", "fail", str(error), "mend the bench file: `softloop check` says the same")
    found = f"kernels of {ready.kernel_modules} modules, trajectory {ready.trajectory_s:.1f} s"
    return Check("bench", "pass", found, "", {"kernel_modules": ready.kernel_modules, "trajectory_s": ready.trajectory_s})


def timing(bench: Bench, seen: dict[str, Any] | str, *, real: bool) -> list[Check]:
    """The checks on what the child measured; a text instead is how it failed."""
    if isinstance(seen, str):
        return [Check("tick lateness", "fail", f"could not be measured: {seen}", "see that `softloop check` says good")]
    checks = [*permissions(bench, seen, real=real), lateness(bench, seen["late_ns"], seen["skipped"])]
    if "zenoh_error" in seen:
        return [*checks, Check("Zenoh round trip", "fail", seen["zenoh_error"], "look at [zenoh] endpoint")]
    return [*checks, zenoh(bench, seen["round_trips_ns"], seen["lost"])]


def _measure_in_child(bench_file: Path, seconds: float) -> dict[str, Any] | str:
    """In a process of its own, since priority and locked memory stay with whoever took them."""
    command = [*PROGRAM, "doctor-ticks", str(bench_file), "--seconds", str(seconds)]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=2 * seconds + CHILD_SLACK_S, check=False, stdin=subprocess.DEVNULL
        )
        found: dict[str, Any] = json.loads(done.stdout)
    except subprocess.TimeoutExpired:
        return "it did not end"
    except ValueError:
        return done.stderr.strip().splitlines()[-1] if done.stderr.strip() else f"ended with code {done.returncode}"
    return found


def lines(bench: Bench, checks: Sequence[Check]) -> list[str]:
    """For a person: a line for each check, and what to do below it."""
    width = max(len(check.name) for check in checks)
    said = []
    for check in checks:
        first, *more = check.found.splitlines()
        said += [f"{check.verdict}  {check.name:{width}}  {first}", *(f"{'':{width + 8}}{line}" for line in more)]
        said += [f"{'':{width + 8}}-> {check.do}"] if check.do else []
    return [*said, f"bench '{bench.name}' on {socket.gethostname()}: {worst(c.verdict for c in checks)}"]


def certified(bench: Bench, checks: Sequence[Check], host: str = "") -> dict[str, Any]:
    """What `--json` prints and a certificate holds: who was examined, when, on what, and every check."""
    return {
        "bench": bench.name,
        "verdict": worst(check.verdict for check in checks),
        "made_wall_ns": read_origin(bench.name, WallClock().now_ns()).wall_ns,
        "host": socket.gethostname(),
        "host_of_bench": host,
        "versions": versions(),
        "checks": [asdict(check) for check in checks],
    }


def _write(file: Path, answer: dict[str, Any]) -> None:
    try:
        file.write_text(json.dumps(answer, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise Unavailable(f"{file}: cannot be written: {error.strerror or error}") from None
