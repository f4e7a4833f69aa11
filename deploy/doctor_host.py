"""What the doctor says of the computer: permissions, tick lateness, Zenoh, disk and versions."""

from __future__ import annotations

import os
import shutil
import statistics
import sys
import tempfile
import time
from bisect import bisect_right
from collections.abc import Sequence
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.version import Version

from softloop.deploy.bench import Bench
from softloop.deploy.doctor_check import Check, Verdict, judged, worst
from softloop.deploy.rotate import MIB, RunFolder, runs_of
from softloop.watch.config import RecorderConfig
from softloop.wire.channels import CHANNELS
from softloop.wire.mcap_layout import versions
from softloop.wire.messages import message
from softloop.wire.schedule import PERIOD_NS

EDGES_US = (0, 50, 100, 200, 500, 1000, 2000, 5000, 10_000)
COSTS_AT_MOST = 0.01  # part of all ticks that may be so late that they cost the gate's tick
LOST_AT_MOST = 0.01
DRIFT_FACTOR, DRIFT_US = 1.5, 200.0  # from the first third to the last, in the median; both must be passed
RT_GUARD = Path("/proc/sys/kernel/sched_rt_runtime_us")
RECORD_BYTES = 31  # what MCAP adds to a message
WRITES, WRITE_BYTES, WRITES_AT_MOST_S = 40, 256 * 1024, 10.0
BUDGET_WARN = 0.9
FULL_MIN, TIGHT_MIN = 10.0, 60.0  # minutes of log for which there is room: less fails, less warns
SEE = "see docs/real-time.md"


def permissions(bench: Bench, seen: dict[str, Any], *, real: bool) -> list[Check]:
    """SCHED_FIFO and locked memory. With real devices a refusal is a failure: under load the gate would fault."""
    if bench.host.realtime_priority == 0:
        return [Check("real-time priority", "pass", "not asked for ([host] realtime_priority = 0)")]
    refused: Verdict = "fail" if real else "warn"
    grant = f"grant it as root and log in again, {SEE}"
    checks = [_priority(bench.host.realtime_priority, grant, refused, granted=seen["realtime"])]
    if bench.host.lock_memory:
        kib = seen["locked_kib"]
        measured = {"locked_kib": kib}
        found = f"{kib / 1024:.0f} MiB locked" if kib else "memory cannot be locked"
        checks.append(Check("memory lock", "pass" if kib else refused, found, "" if kib else grant, measured))
    return checks


def _priority(priority: int, grant: str, refused: Verdict, *, granted: bool) -> Check:
    measured: dict[str, Any] = {"granted": granted, "priority": priority}
    if not granted:
        return Check("real-time priority", refused, f"SCHED_FIFO {priority} is not permitted", grant, measured)
    guard = measured["sched_rt_runtime_us"] = int(RT_GUARD.read_text()) if RT_GUARD.is_file() else None
    if guard == -1:
        do = f"set kernel.sched_rt_runtime_us back to 950000: a spinning process would lock up the machine; {SEE}"
        return Check("real-time priority", "warn", f"SCHED_FIFO {priority} granted, without the kernel's guard", do, measured)
    return Check("real-time priority", "pass", f"SCHED_FIFO {priority} granted", "", measured)


def lateness(bench: Bench, late_ns: Sequence[int], skipped: int) -> Check:
    """Ticks against what they cost: later than the gate waits, a tick; longer than it holds the last command, a fault."""
    wait_us = bench.valves.command_wait_ms * 1e3 if bench.valves else 1500.0
    hold_us = (bench.valves.hold_ticks if bench.valves else 3) * PERIOD_NS * 1e-3
    late_us = sorted(late * 1e-3 for late in late_ns)
    costly = sum(late > wait_us for late in late_us) / len(late_us)
    verdict = worst([judged(late_us[-1], wait_us, hold_us), judged(costly, 0.0, COSTS_AT_MOST)])
    shape = histogram(late_us)
    found = (
        f"{len(late_us)} ticks: median {quantile(late_us, 0.5):.0f} us, 99 % {quantile(late_us, 0.99):.0f} us, "
        f"most {late_us[-1]:.0f} us; skipped {skipped}\n{bars(shape)}"
    )
    do = f"leave two cores to the rig, run nothing beside it, grant real-time priority ({SEE}); look for power saving in the BIOS"
    measured = {
        "ticks": len(late_us), "median_us": quantile(late_us, 0.5), "p99_us": quantile(late_us, 0.99), "max_us": late_us[-1],
        "skipped": skipped, "later_than_gate_waits": costly, "histogram_us": shape,
    }  # fmt: skip
    return Check("tick lateness", verdict, found, "" if verdict == "pass" else do, measured)


def histogram(values_us: Sequence[float]) -> dict[str, int]:
    """Lower edge of each bin, us -> how many; values below the first edge count in the first bin."""
    counts = dict.fromkeys(map(str, EDGES_US), 0)
    for value in values_us:
        counts[str(EDGES_US[max(0, bisect_right(EDGES_US, value) - 1)])] += 1
    return counts


def bars(shape: dict[str, int], width: int = 40) -> str:
    """A histogram as lines of text; a bin that is not empty has a mark at least."""
    most = max(shape.values()) or 1
    ends = [*(f"to {end:>6} us" for _, end in pairwise(shape)), f"from {EDGES_US[-1]} us"]
    return "\n".join(
        f"{end:>14} {count:>6} {'#' * -(-count * width // most)}".rstrip()
        for end, count in zip(ends, shape.values(), strict=True)
    )


def quantile(ordered: Sequence[float], part: float) -> float:
    """The value below which `part` of an ordered sequence lies."""
    return ordered[min(len(ordered) - 1, int(part * len(ordered)))]


def zenoh(bench: Bench, trips_ns: Sequence[int], lost: int) -> Check:
    """Two hops there and back, as a sample and its command have: against the delay that the gate's budgets allow for them."""
    declared_us = bench.valves.path_delay_ms * 1e3 if bench.valves else 2000.0
    slack_us = (bench.valves.age_ticks if bench.valves else 3) * PERIOD_NS * 1e-3
    where = f"{bench.zenoh.mode}, {bench.zenoh.meeting_point(bench.name).split('/', 1)[0]}"
    measured: dict[str, Any] = {"lost": lost, "round_trips": len(trips_ns)}
    if len(trips_ns) < 3:
        do = "look at [zenoh] endpoint and whether this user may make sockets there"
        return Check("Zenoh round trip", "fail", f"{where}: nothing came back of {lost} messages", do, measured)
    trips_us = [trip * 1e-3 for trip in trips_ns]
    ordered = sorted(trips_us)
    median, most = quantile(ordered, 0.5), ordered[-1]
    first, last = drift(trips_us)
    drifts = last > first * DRIFT_FACTOR and last - first > DRIFT_US
    share = lost / (lost + len(trips_us))
    tail = judged(most, declared_us, declared_us + slack_us)
    verdict = worst(
        [judged(median, declared_us / 2, declared_us), tail, judged(share, 0.0, LOST_AT_MOST), "warn" if drifts else "pass"]
    )
    measured |= {
        "median_us": median,
        "p99_us": quantile(ordered, 0.99),
        "max_us": most,
        "first_third_us": first,
        "last_third_us": last,
    }
    found = (
        f"{where}: median {median:.0f} us, 99 % {quantile(ordered, 0.99):.0f} us, most {most:.0f} us; lost {lost}; "
        f"median of the first third {first:.0f} us, of the last {last:.0f} us"
    )
    do = f"above {declared_us:.0f} us a sample answers late: run nothing beside the rig; use Unix sockets on one machine"
    return Check("Zenoh round trip", verdict, found, "" if verdict == "pass" else do, measured)


def drift(values: Sequence[float]) -> tuple[float, float]:
    """Medians of the first and of the last third."""
    third = max(1, len(values) // 3)
    return statistics.median(values[:third]), statistics.median(values[-third:])


def log_bytes_s() -> float:
    """What a run logs per second before compression, from the channel table: all channels at their rates."""
    return sum((message(c.message).size + RECORD_BYTES) * c.rate_hz for c in CHANNELS if c.logged)


def disk(bench: Bench, folder: Path, *, recorded: bool = True) -> list[Check]:
    """Writes that are made safe one by one, and room for the log, where the runs of this bench go, if it is `recorded` here."""
    if bench.recorder is None or not recorded:
        return [Check("disk", "pass", "no recorder on this bench" if recorded else "the recorder is on another host")]
    try:
        stalls_s = sorted(write_stalls(folder))
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return [Check("disk stalls", "fail", f"{folder}: {error.strerror or error}", "make [run] folder writable for this user")]
    budget = [_budget(bench.recorder, runs_of(bench))] if bench.recorder.budget_mib else []
    return [_stalls(bench, folder, stalls_s), _room(folder, free), *budget]


def write_stalls(folder: Path) -> list[float]:
    """How long each of some writes took until the disk had it, s. Raises OSError. Leaves no file."""
    stalls_s: list[float] = []
    end_s = time.monotonic() + WRITES_AT_MOST_S
    with tempfile.TemporaryFile(dir=folder) as file:
        while len(stalls_s) < WRITES and time.monotonic() < end_s:
            began_s = time.monotonic()
            file.write(os.urandom(WRITE_BYTES))
            file.flush()
            os.fsync(file.fileno())
            stalls_s.append(time.monotonic() - began_s)
    return stalls_s


def _stalls(bench: Bench, folder: Path, stalls_s: Sequence[float]) -> Check:
    assert bench.recorder is not None
    held_s = bench.recorder.unwritten_mib * 2**20 / log_bytes_s()
    verdict = judged(stalls_s[-1], bench.recorder.flush_s, held_s)
    found = (
        f"{folder}: {len(stalls_s)} writes of {WRITE_BYTES >> 10} KiB: median {quantile(stalls_s, 0.5) * 1e3:.1f} ms, "
        f"most {stalls_s[-1] * 1e3:.1f} ms; the recorder bears {held_s:.0f} s"
    )
    do = "let runs go to a disk of their own ([run] folder), not to a network share or a worn SD card"
    measured = {"median_ms": quantile(stalls_s, 0.5) * 1e3, "max_ms": stalls_s[-1] * 1e3, "recorder_bears_s": held_s}
    return Check("disk stalls", verdict, found, "" if verdict == "pass" else do, measured)


def _room(folder: Path, free: int) -> Check:
    minutes = free / log_bytes_s() / 60.0
    verdict: Verdict = "fail" if minutes < FULL_MIN else "warn" if minutes < TIGHT_MIN else "pass"
    found = f"{folder}: {free / 1e9:.1f} GB free, room for {minutes / 60.0:.1f} h of log before compression"
    do = "make room: `softloop log prune`, or another [run] folder"
    return Check("disk space", verdict, found, "" if verdict == "pass" else do, {"free_bytes": free, "minutes": minutes})


def _budget(config: RecorderConfig, runs: Sequence[RunFolder]) -> Check:
    """What is left of `[recorder] budget_mib`: a run is refused above it, unless older ones may go."""
    used = sum(run.n_bytes for run in runs) / MIB
    found = f"{len(runs)} runs hold {used:.0f} MiB of {config.budget_mib}"
    measured = {"runs": len(runs), "used_mib": used, "budget_mib": config.budget_mib}
    if config.over_budget == "remove" or used <= BUDGET_WARN * config.budget_mib:
        return Check("disk budget", "pass", found, "", measured)
    verdict: Verdict = "fail" if used > config.budget_mib else "warn"
    return Check("disk budget", verdict, found, 'make room: `softloop log prune`; or over_budget = "remove"', measured)


def existing(folder: Path) -> Path:
    """The folder, or the nearest one around it that is there."""
    folder = folder.resolve()
    return next(path for path in (folder, *folder.parents) if path.is_dir())


def library_versions() -> Check:
    """Python, kernel and the libraries that bear on results, against what softloop asks for."""
    found = versions()
    wrong = [f"{name} {there}, needs {wanted}" for name, there, wanted in _outside()]
    shown = ", ".join(f"{name} {found[name]}" for name in ("softloop", "python", "zenoh", "numba", "numpy", "kernel"))
    if wrong:
        return Check("versions", "fail", f"{shown}; {'; '.join(wrong)}", "install with requirements.lock", dict(found))
    if not sys.platform.startswith("linux"):
        return Check("versions", "warn", f"{shown}; not Linux", "real-time priority and CAN need Linux", dict(found))
    return Check("versions", "pass", shown, "", dict(found))


def _outside() -> list[tuple[str, str, str]]:
    """(library, installed version, what softloop asks for) where these do not agree."""
    wrong = []
    for text in metadata.requires("softloop") or ():
        asked = Requirement(text)
        if asked.marker is not None and not asked.marker.evaluate({"extra": ""}):
            continue
        try:
            there = metadata.version(asked.name)
        except metadata.PackageNotFoundError:
            wrong.append((asked.name, "is missing", str(asked.specifier)))
            continue
        if Version(there) not in asked.specifier:
            wrong.append((asked.name, there, str(asked.specifier)))
    return wrong
