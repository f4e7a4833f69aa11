"""What the page says of a bench besides its curves, as JSON, ten times a second."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from typing import Any

from softloop.watch.overview import LATE_EDGES_US, Overview
from softloop.wire.channels import CAN, SHADOW, VALVES
from softloop.wire.messages import names_of

FRESH_S = 1.0
EVENTS_SHOWN = 60
_GATES = names_of("ValveStatus", "GATE_")
_OUTPUTS = names_of("ValveStatus", "OUTPUT_")
_REASONS = names_of("ValveStatus", "REASON_")
_DRIVERS = names_of("ValveStatus", "DRIVER_")
_PHASES = names_of("CycleRecord", "PHASE_")
_MODES = names_of("ValveCommand", "MODE_")
_FAULTS = names_of("Event", "FAULT_")
_STATES = names_of("ProcessStatus", "STATE_")
_NUMBERS = (
    "angle_deg", "rate_deg_s", "reference_deg", "error_deg", "chamber_pressure_kpa", "supply_pressure_kpa",
    "desired_pressure_kpa", "charge_current_ma", "exhaust_current_ma", "tick", "stamp_ns", "skipped_total",
)  # fmt: skip

EventLine = Callable[[Any], str]


def plain(value: Any) -> Any:
    """A value as JSON can hold it: what is not finite becomes None."""
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def as_json(value: dict[str, Any]) -> str:
    return json.dumps(plain(value), allow_nan=False, separators=(",", ":"))


def state_of(overview: Overview, now_s: float | None = None) -> dict[str, Any]:
    """Everything but curves and events; ages count from `now_s`, this machine's monotonic clock."""
    now_s = time.monotonic() if now_s is None else now_s
    cycle, valves = overview.cycle, overview.valves
    heard = _heard(overview)
    found: dict[str, Any] = {
        "kind": "state",
        "heard_s": {name: round(now_s - at, 3) for name, at in heard.items()},
        "running": bool(heard) and now_s - max(heard.values()) < FRESH_S,
        "gate": _gate(overview, heard, now_s),
        "processes": _processes(overview, now_s),
        "buses": {name: round(bus.load_percent, 2) for name, bus in overview.buses.items()},
        "rates": _rates(overview),
        "broken": [_FAULTS.get(number, "?") for number, count in sorted(overview.broken.items()) if count],
        "late": {"counts": overview.lateness_histogram(), **overview.lateness_spread_us()},
    }
    if valves is not None:
        found["coils"] = {"charge_ma": valves.charge_coil_ma, "exhaust_ma": valves.exhaust_coil_ma}
    shadow = overview.newest.get(SHADOW.name)
    if shadow is not None:
        found["shadow"] = {name: getattr(shadow, name) for name in ("angle_rms_deg", "chamber_rms_kpa")}
    if cycle is not None:
        found["cycle"] = {name: getattr(cycle, name) for name in _NUMBERS}
        found["phase"] = _PHASES.get(cycle.phase, "?")
        found["mode"] = _MODES.get(cycle.mode, "-")
        found["trajectory_s"] = cycle.trajectory_ns * 1e-9
        found["ages_ms"] = {"pressure": cycle.pressure_age_ns * 1e-6, "inclination": cycle.inclination_age_ns * 1e-6}
        found["theta"] = cycle.theta
        found["adapting"] = bool(cycle.adapting)
    return found


def _heard(overview: Overview) -> dict[str, float]:
    heard: dict[str, float] = {}
    for lane in overview.lanes.values():
        heard[lane.channel.name] = max(lane.heard_s, heard.get(lane.channel.name, 0.0))
    return heard


def _gate(overview: Overview, heard: dict[str, float], now_s: float) -> dict[str, Any]:
    valves = overview.valves
    if valves is None or now_s - heard.get(VALVES.name, 0.0) > FRESH_S:
        return {"state": "silent", "output": "-", "reason": "none", "driver": "-"}
    return {
        "state": _GATES.get(valves.gate, "?"),
        "output": _OUTPUTS.get(valves.output, "?"),
        "reason": _REASONS.get(valves.reason, "?").replace("_", " "),
        "driver": _DRIVERS.get(valves.driver, "?"),
    }


def _processes(overview: Overview, now_s: float) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "state": _STATES.get(status.state, "?"),
            "pid": status.pid,
            "late_ms": status.late_max_ns * 1e-6,
            "skipped": status.skipped,
            "dropped": status.dropped,
            "realtime": bool(status.realtime),
            "heard_s": round(now_s - heard_s, 1),
        }
        for name, (status, heard_s) in sorted(overview.statuses.items())
    ]


def _rates(overview: Overview) -> dict[str, float]:
    rates: dict[str, float] = {}
    for lane in overview.lanes.values():
        if lane.channel.rate_hz >= 10 or lane.channel is CAN:
            rates[lane.channel.name] = round(rates.get(lane.channel.name, 0.0) + lane.rate_hz, 1)
    return rates


def events_of(overview: Overview, event_line: EventLine, start_ns: int) -> dict[str, Any]:
    """The newest events in words, newest first, with their time since `start_ns`."""
    newest = list(overview.events)[-EVENTS_SHOWN:]
    lines = [{"time_s": round((event.stamp_ns - start_ns) * 1e-9, 3), "text": event_line(event)} for event in reversed(newest)]
    return {"kind": "events", "seen": overview.events_seen, "events": lines}


def late_edges_ms() -> list[float]:
    """The finite edges of the lateness histogram's bins, ms."""
    return [round(float(edge) * 1e-3, 4) for edge in LATE_EDGES_US if math.isfinite(float(edge))]
