"""What the doctor says of the computer's clocks: what counts the rig's time, and whether the time of day is kept right."""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

from softloop.deploy.doctor_check import Check

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
