"""What the doctor says of clocks: what counts the rig's time, the time of day, and how far another host's clock is away."""

from __future__ import annotations

import ctypes
import statistics
import time
from pathlib import Path
from typing import Any

from softloop.deploy.bench import Bench
from softloop.deploy.doctor_check import Check, Verdict
from softloop.deploy.hosts import launcher_name, leader, number_of, on_host
from softloop.wire.clock_config import ClockConfig
from softloop.wire.clock_offset import Exchange
from softloop.wire.errors import SoftloopError
from softloop.wire.host_clock import Follower, TimeQuestion
from softloop.wire.session import open_wire

SOURCE_FILE = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
SLOW_SOURCES = ("hpet", "acpi_pm", "jiffies", "refined-jiffies")  # a look at these costs microseconds, or they step
UNSYNCHRONISED = 0x40  # sys/timex.h, STA_UNSYNC
DAY_WARN_MS = 1000.0  # the time of day stands in names of runs and at the start of a log; stamps do not come from it


class _Timex(ctypes.Structure):
    """The head of `struct timex`; the rest is only room for what the kernel writes."""

    _fields_ = (
        ("modes", ctypes.c_uint), ("offset", ctypes.c_long), ("freq", ctypes.c_long), ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long), ("status", ctypes.c_int), ("rest", ctypes.c_long * 64),
    )  # fmt: skip


def clock_source() -> str:
    """What the kernel's monotonic clock counts by, or an empty text where it does not say."""
    try:
        return SOURCE_FILE.read_text(encoding="ascii").strip()
    except OSError:
        return ""


def day_error_ms() -> float | None:
    """The most that the time of day may be wrong by the kernel's own account, ms; None when nobody keeps it right."""
    state = _Timex()
    if ctypes.CDLL(None).adjtimex(ctypes.byref(state)) < 0 or state.status & UNSYNCHRONISED:
        return None
    return float(state.maxerror) * 1e-3


def clock(source: str, error_ms: float | None) -> Check:
    """All stamps of one computer are of one clock; its kind is looked at, and the time of day beside it."""
    measured: dict[str, Any] = {"source": source, "day_error_ms": error_ms}
    day = "nobody sets the time of day" if error_ms is None else f"time of day within {error_ms:.0f} ms"
    found = f"monotonic clock by {source or 'an unnamed source'}; {day}"
    if source in SLOW_SOURCES:
        do = "boot with clocksource=tsc where the CPU has a stable one, or take another computer"
        return Check("clock", "warn", found, do, measured)
    if error_ms is None or error_ms > DAY_WARN_MS:
        do = "let chrony or systemd-timesyncd keep it; logs bear its time, and nothing else depends on it"
        return Check("clock", "warn", found, do, measured)
    return Check("clock", "pass", found, "", measured)


def offset(bench: Bench, host: str, seconds: float) -> Check:
    """How far this host's clock is from that of the host which leads, asked of its launcher as a run does."""
    if host == leader(bench):
        return Check("clock offset", "pass", "this host keeps the rig clock")
    try:
        exchanges = exchanged(bench, host, seconds)
    except SoftloopError as error:
        return _unknown(bench, str(error))
    return judge_offset(bench.clock, exchanges, number_of(bench, host)) if exchanges else _unknown(bench, "nobody answers")


def _unknown(bench: Bench, why: str) -> Check:
    first = f"softloop run --host {leader(bench)}"
    return Check("clock offset", "warn", why, f"start `{first}` there, which waits for the others, and ask again here")


def exchanged(bench: Bench, host: str, seconds: float) -> list[Exchange]:
    """Questions for the time, each `[clock] period_ms`, and their answers. Raises Unavailable when there is no way to ask."""
    found: list[Exchange] = []
    with open_wire(on_host(bench, host).zenoh, bench.name, launcher_name(bench, host)) as wire:  # who has the right to ask
        wire.settle(lambda: False)
        question, end_s = TimeQuestion(wire), time.monotonic() + seconds
        while time.monotonic() < end_s:
            exchange = question.ask()
            found += [exchange] if exchange is not None else []
            time.sleep(bench.clock.period_ms * 1e-3)
    return found


def judge_offset(config: ClockConfig, exchanges: list[Exchange], number: int) -> Check:
    """The offset at the last exchange, as sure as `[clock]` asks for, and clocks that do not run apart faster than it allows."""
    follower = Follower(config, number)
    for exchange in exchanges:
        follower.learn(exchange)
    end_ns = exchanges[-1].answered_ns
    known, unsure_ms = follower.estimator.at(end_ns), follower.uncertainty_ns(end_ns) * 1e-6
    trip_us = statistics.median(exchange.delay_ns for exchange in exchanges) * 1e-3
    drifts = abs(known.drift_ppm) - known.drift_error_ppm > config.drift_max_ppm
    verdict: Verdict = "fail" if unsure_ms > config.uncertainty_max_ms or drifts or follower.estimator.steps else "pass"
    found = (
        f"{known.offset_ns * 1e-6:.3f} ms, known to {unsure_ms:.3f} ms (allowed {config.uncertainty_max_ms:g}); drift "
        f"{known.drift_ppm:.1f} ppm, known to {known.drift_error_ppm:.1f}; steps {follower.estimator.steps}; "
        f"round trip {trip_us:.0f} us, {len(exchanges)} of them"
    )
    do = "a quieter network between the hosts; a clock that steps or drifts is one that a program sets: it must not"
    measured = {
        "offset_ms": known.offset_ns * 1e-6, "uncertainty_ms": unsure_ms, "drift_ppm": known.drift_ppm,
        "drift_error_ppm": known.drift_error_ppm, "steps": follower.estimator.steps, "round_trip_us": trip_us,
    }  # fmt: skip
    return Check("clock offset", verdict, found, "" if verdict == "pass" else do, measured)
