"""A plausible run with every channel, written through the layout that the recorder uses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softloop.wire.channels import CAN, CHANNELS, can_key, key
from softloop.wire.mcap_layout import LogWriter, Origin
from softloop.wire.messages import message

BENCH = "synthetic"
MS = 1_000_000
PERIOD_NS = 5 * MS
START_CLOCK_NS = 1_000_000_000_000
START_WALL_NS = 1_760_000_000_000_000_000
ORIGIN = Origin(BENCH, START_WALL_NS, START_CLOCK_NS)
BENCH_TOML = b'name = "synthetic"\n\n[controller]\nlaw = "arc"\n'
GIT = b'{"commit": "abc", "dirty": false}\n'
BY_NAME = {c.name: c for c in CHANNELS}

APPROACH_TICKS = 20
THETA = tuple(float(k) for k in range(14))

# The hops of every sample and command, in ns after the tick they belong to (negative: before it).
HOPS_NS = {
    "pressure_sampled": -4_000_000,
    "pressure_received": -3_700_000,
    "pressure_published": -3_600_000,
    "inclination_sampled": -4_500_000,
    "inclination_received": -2_500_000,
    "inclination_published": -2_400_000,
    "woken": 60_000,
    "computed": 160_000,
    "published": 220_000,
    "gate_received": 500_000,
    "frame_sent": 560_000,
    "frame_end": 830_000,
    "applied": 830_000,
}


@dataclass(frozen=True)
class Made:
    """What the builder put in and a test may expect to get out."""

    angle_deg: np.ndarray[Any, Any]
    reference_deg: np.ndarray[Any, Any]
    phase: np.ndarray[Any, Any]


def reference_deg(seconds: float, moving: bool) -> np.ndarray[Any, Any]:
    """Point to point with dwells, or two sines."""
    t = np.arange(0.0, seconds, 0.005)
    if moving:
        return 80.0 + 20.0 * np.sin(2 * np.pi * 0.2 * t) + 8.0 * np.sin(2 * np.pi * 0.45 * t + 1.0)
    steps = np.array([40.0, 70.0, 100.0, 130.0, 100.0, 70.0, 40.0])
    at = np.clip(t / seconds * (len(steps) - 1) * 1.0, 0, len(steps) - 1.0001)
    low = at.astype(int)
    u = np.clip((at - low - 0.6) / 0.4, 0.0, 1.0)
    return steps[low] + (steps[low + 1] - steps[low]) * (u**3 * (10 - 15 * u + 6 * u * u))


def messages(seconds: float = 4.0, *, moving: bool = False, seed: int = 1, jitter_ns: int = 0) -> Iterator[tuple[str, str, Any]]:
    """(channel name, key, named tuple) of a run, in the order in which a recorder would get them."""
    noise = np.random.RandomState(seed)
    y = reference_deg(seconds, moving)
    rate = np.gradient(y, 0.005)
    rate[np.abs(rate) < 1e-6] = 0.0
    n = len(y)
    error = 1.5 * np.exp(-np.arange(n) * 0.005 / 0.8) + 0.02 * rate + noise.normal(0, 0.05, n)
    for i in range(n):
        late_ns = int(noise.exponential(jitter_ns)) if jitter_ns else 0
        yield from _tick(i, y[i], rate[i], error[i], late_ns)
        if i % 200 == 0:
            yield _of("status", seq=i // 200 + 1, stamp_ns=_at(i), pid=7, cycles=i, process=1, state=1)
    yield _of("request", seq=1, stamp_ns=_at(0), origin=9, action=1)
    yield _of("event", seq=1, stamp_ns=_at(0), source=1, kind=1, code=1, reason=12)
    yield _of("event", seq=2, stamp_ns=_at(n - 1), source=1, kind=1, code=0, reason=14)


def _at(i: int) -> int:
    return START_CLOCK_NS + 100 * MS + i * PERIOD_NS


def _of(name: str, **values: Any) -> tuple[str, str, Any]:
    channel = BY_NAME[name]
    return name, key(BENCH, channel), message(channel.message).make(**values)


def _tick(i: int, y: float, rate: float, error: float, late_ns: int) -> Iterator[tuple[str, str, Any]]:
    t, h = _at(i), {k: _at(i) + v + (late_ns if v > 0 else 0) for k, v in HOPS_NS.items()}
    charge, exhaust = (90.0 + rate, 0.0) if rate > 0 else (0.0, 90.0 - rate) if rate < 0 else (0.0, 0.0)
    mode = 1 if rate > 0 else 2 if rate < 0 else 3
    pressure = (y - 26.75) * 0.85
    truth = {"seq": i + 1, "stamp_ns": t - MS, "angle_deg": y + error, "rate_deg_s": rate, "chamber_pressure_kpa": pressure}
    truth |= {"supply_pressure_kpa": 200.0, "charge_coil_ma": charge, "exhaust_coil_ma": exhaust, "command_counter": max(0, i)}
    truth |= {
        "command_end_ns": h["frame_end"] - PERIOD_NS,
        "command_applied_ns": h["applied"] - PERIOD_NS,
        "late_max_ns": 300_000,
    }
    yield _of("truth", **truth)
    stamps = {k: h[f"pressure_{v}"] for k, v in (("stamp_ns", "sampled"), ("received_ns", "received"))}
    stamps["published_ns"] = h["pressure_published"]
    yield _of("pressure", seq=i + 1, **stamps, supply_pressure_kpa=200.0, chamber_pressure_kpa=pressure)
    stamps = {k: h[f"inclination_{v}"] for k, v in (("stamp_ns", "sampled"), ("received_ns", "received"))}
    stamps["published_ns"] = h["inclination_published"]
    yield _of("inclination", seq=i + 1, **stamps, angle_deg=y + error + 0.01, rate_deg_s=rate)
    yield _cycle(i, y, rate, error, (charge, exhaust, mode), h)
    asked = {"charge_current_ma": charge, "exhaust_current_ma": exhaust, "mode": mode, "ready": 1}
    yield _of("command", seq=i + 1, stamp_ns=h["computed"], tick=i, **asked)
    sent = {"command_seq": i + 1, "tick": i, "command_received_ns": h["gate_received"], "driver_stamp_ns": t}
    currents = {"charge_current_ma": charge, "exhaust_current_ma": exhaust, "charge_coil_ma": charge, "exhaust_coil_ma": exhaust}
    yield _of("valves", seq=i + 1, stamp_ns=h["frame_sent"], **sent, **currents, gate=1, output=1)
    frame = message("CanFrame").make(seq=i + 1, stamp_ns=h["frame_sent"], node=11, arbitration_id=0x80, dlc=8, data=(1,) * 8)
    yield "can", can_key(BENCH, "can0", 0x80), frame


def _cycle(i: int, y: float, rate: float, error: float, drive: tuple[float, float, int], h: dict[str, int]) -> Any:
    t = _at(i)
    cycle = {
        "seq": i + 1,
        "stamp_ns": t,
        "tick": i,
        "woken_ns": h["woken"],
        "computed_ns": h["computed"],
        "published_ns": h["published"],
    }
    cycle |= {"pressure_seq": i + 1, "pressure_stamp_ns": h["pressure_sampled"], "pressure_age_ns": t - h["pressure_sampled"]}
    cycle |= {"inclination_seq": i + 1, "inclination_stamp_ns": h["inclination_sampled"], "valve_seq": i}
    cycle |= {"inclination_age_ns": t - h["inclination_sampled"], "trajectory_ns": (i - APPROACH_TICKS) * PERIOD_NS}
    measured = {"supply_pressure_kpa": 200.0, "chamber_pressure_kpa": (y - 26.75) * 0.85, "angle_deg": y + error + 0.01}
    measured |= {
        "reference_deg": y,
        "reference_rate_deg_s": rate,
        "angle_estimate_deg": y + error,
        "error_deg": error,
        "rate_deg_s": rate,
    }
    measured |= {"desired_pressure_kpa": (y - 26.75) * 0.85 + 1.0, "charge_current_ma": drive[0], "exhaust_current_ma": drive[1]}
    return _of(
        "cycle", **cycle, **measured, theta=THETA, phase=1 if i < APPROACH_TICKS else 2, gate=1, mode=drive[2], inputs_valid=1
    )


def write_log(path: Path, made: list[tuple[str, str, Any]], *, finish: bool = True, chunk_bytes: int = 64 * 1024) -> Path:
    """Write messages as a log; `finish=False` leaves it as a killed recorder would, all chunks closed."""
    attachments = {
        "bench.toml": BENCH_TOML,
        "versions.json": b'{"python": "3.11"}\n',
        "git.json": b'{"commit": "abc", "dirty": false}\n',
    }
    with path.open("wb") as file:
        writer = LogWriter(file, ORIGIN, attachments, chunk_bytes)
        for name, full_key, value in made:
            writer.add(full_key, BY_NAME.get(name, CAN), message(BY_NAME[name].message).pack(value))
        writer.flush()
        if finish:
            writer.finish()
    return path
