"""`softloop doctor`: accepts the computer and the devices before the rig runs, line by line, with what to do."""

from __future__ import annotations

import json
import socket
import subprocess
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from softloop.deploy.bench import Bench, find_bench, load_bench
from softloop.deploy.children import PROGRAM
from softloop.deploy.doctor_check import Check, worst
from softloop.deploy.doctor_devices import devices, is_real
from softloop.deploy.doctor_host import disk, existing, lateness, library_versions, permissions, zenoh
from softloop.deploy.router import launcher_wire
from softloop.deploy.run_dir import bench_lock
from softloop.wire.clock import WallClock
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK, Unavailable
from softloop.wire.mcap_layout import read_origin, versions

CHILD_SLACK_S = 40.0


def doctor(bench_file: Path, seconds: float, certificate: Path | None, *, as_json: bool) -> int:
    """Examine, say it, and write the certificate; EXIT_NEGATIVE when something fails.

    Raises:
        BadFile, BadConfig: the bench file is wrong.
        Unavailable: the bench is running: a machine is examined at rest; or the certificate cannot be written.
    """
    bench = load_bench(find_bench(bench_file))
    with bench_lock(bench.name):
        checks = examine(bench, bench_file, seconds)
    answer = certified(bench, checks)
    if certificate is not None:
        _write(certificate, answer)
    print(json.dumps(answer, indent=2) if as_json else "\n".join(lines(bench, checks)))
    return EXIT_NEGATIVE if answer["verdict"] == "fail" else EXIT_OK


def examine(bench: Bench, bench_file: Path, seconds: float) -> list[Check]:
    """All checks, in the order in which they matter to a person. Raises Unavailable when the bench is running."""
    with launcher_wire(bench) as wire, Console(stderr=True).status("listening to the machine and the devices"):
        seen = _measure_in_child(bench_file, seconds)
        checks = [*timing(bench, seen), *devices(bench, wire, seconds)]
    return [*checks, *disk(bench, existing(Path(bench.run.folder))), library_versions()]


def timing(bench: Bench, seen: dict[str, Any] | str) -> list[Check]:
    """The checks on what the child measured; a text instead is how it failed."""
    if isinstance(seen, str):
        return [Check("tick lateness", "fail", f"could not be measured: {seen}", "see that `softloop check` says good")]
    checks = [*permissions(bench, seen, real=is_real(bench)), lateness(bench, seen["late_ns"], seen["skipped"])]
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


def certified(bench: Bench, checks: Sequence[Check]) -> dict[str, Any]:
    """What `--json` prints and a certificate holds: who was examined, when, on what, and every check."""
    return {
        "bench": bench.name,
        "verdict": worst(check.verdict for check in checks),
        "made_wall_ns": read_origin(bench.name, WallClock().now_ns()).wall_ns,
        "host": socket.gethostname(),
        "versions": versions(),
        "checks": [asdict(check) for check in checks],
    }


def _write(file: Path, answer: dict[str, Any]) -> None:
    try:
        file.write_text(json.dumps(answer, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise Unavailable(f"{file}: cannot be written: {error.strerror or error}") from None
