"""`summary.json`: every figure of a run under one flat key with its unit, for programs; and the same as a table for people."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from softloop.offline import metrics
from softloop.offline.log import Log
from softloop.offline.metrics import SENSORS, TO_BUS, TOTAL, dwells, spread, tracked
from softloop.offline.run_log import find_log, open_run
from softloop.wire.channels import CHANNELS
from softloop.wire.errors import BadFile
from softloop.wire.log_parts import account_of, parts_of
from softloop.wire.messages import constant, names_of

SUMMARY = "summary.json"
# Which process, by its table in the bench file, speaks on a steady channel.
SPOKEN_BY = {"pressure": "pressures", "inclination": "inclinometer", "command": "controller", "cycle": "controller"}
SPOKEN_BY |= {"valves": "valves", "truth": "plant"}
LATE_MAX_MS = 2.0  # a plant that was behind the clock by more simulated another rig than the one that it stands for
Value = float | int | str | bool | None
Paper = dict[str, tuple[float, float | None]]
# The paper's best controller (C3) and its smooth sliding mode (C2): maximum dynamic and steady error, deg (section 4.2).
PAPER_T1: Paper = {"ARC (C3)": (4.36, 0.82), "SMC (C2)": (4.75, 1.56)}
PAPER_T2: Paper = {"ARC (C3)": (3.67, None), "SMC (C2)": (5.27, None)}

NONE = "\N{EN DASH}"  # shown where there is no figure
_PERCENTILE_WORDS = {"p50": "median", "p99": "99th percentile", "p99_9": "99.9th percentile", "max": "maximum"}
_HOP_WORDS = {
    "wire": "sensor's sampling until its adapter had the whole frame or packets",
    "adapter": "adapter: received until handed to Zenoh",
    "wait": "handed to Zenoh until the tick that used it woke",
    "compute": "controller woken until computed",
    "publish": "computed until the command was handed to Zenoh",
    "zenoh": "command handed to Zenoh until the gate had it",
    "gate": "gate: received until the valve frame was handed to the bus",
    "frame": "valve frame handed to the bus until the driver applied it",
    "to_bus": "sensor's sampling until the valve frame was handed to the bus",
    "total": "sensor's sampling until the driver applied the command",
}


def _meanings() -> dict[str, str]:
    """Key -> what it means, for every key that `summarise` can return."""
    found = {
        "bench": "name of the bench",
        "law": "the controller's law, from the bench file",
        "trajectory": "the trajectory, from the bench file",
        "completed": "the trajectory was followed to its end",
        "evidence_valid": "nothing below speaks against using this run as evidence",
        "evidence_problems": "what does, separated by '; '",
        "run_s": "first to last cycle record",
        "track_s": "first to last cycle record of PHASE_TRACK",
        "dwells": "stretches of at least 2 s in which the reference stood still",
        "pressure_error_max_kpa": "largest |chamber pressure less desired| in PHASE_TRACK (the plant's, else as measured)",
        "pressure_error_rms_kpa": "its root mean square",
        "ticks": "cycle records",
        "ticks_skipped": "ticks that the controller left out while the gate was armed",
        "inputs_invalid_ticks": "ticks of PHASE_TRACK on which an input was too old or not valid",
        "saturated_percent": "share of PHASE_TRACK with a command at a limit",
        "mode_switches_per_s": "changes of the working mode per second of PHASE_TRACK",
        "mode_switches_dwell_per_s": "the same within dwells only",
        "messages": "messages in the log",
        "log_problems": "damaged or missing parts of the log file, separated by '; '",
        "silent_channels": "channels whose messages end long before the others' or never came, separated by '; '",
        "recorder_dropped": "messages that the recorder dropped (backlog, storage, malformed); empty without recorder.json",
        "plant_late_max_ms": "the plant's worst lateness behind the clock while the gate was armed; empty without a plant",
        "plant_deadline_misses": "times at which it was late by more than 2 ms, while the gate was armed",
        "gate_faults": "transitions of the gate to FAULT",
        "gate_fault_reasons": "their reasons, separated by '; '",
        "driver_watchdog_trips": "times at which the valve driver vented by itself",
        "clock_uncertainty_max_ms": "largest stated uncertainty of a host's clock against the rig's; empty with one host",
        "clock_steps": "jumps of a host's clock against the rig's",
        "events": "events in the log",
    }
    for kind, of in (("truth", "the plant's true angle"), ("sensor", "the inclinometer's angle")):
        found[f"{kind}_error_max_deg"] = f"largest |{of} less reference| from the first sample of PHASE_TRACK, none left out"
        found[f"{kind}_error_max_at_s"] = "when that was, since the first sample of PHASE_TRACK"
        found[f"{kind}_error_rms_deg"] = f"root mean square of {of} less reference in PHASE_TRACK"
        found[f"{kind}_error_steady_deg"] = f"largest |{of} less reference| within the last 2 s of every dwell"
    for name, word in _PERCENTILE_WORDS.items():
        found[f"tick_late_{name}_us"] = f"woken less scheduled, {word}"
    for sensor in SENSORS:
        for hop, text in _HOP_WORDS.items():
            for name in ("p50", "p99", "max"):
                found[f"latency_{sensor}_{hop}_{name}_us"] = f"{text}, {_PERCENTILE_WORDS[name]}"
    for channel in CHANNELS:
        if channel.logged:
            found[f"messages_{channel.name}"] = f"messages logged on {channel.name}"
            found[f"missing_{channel.name}"] = f"messages missing on {channel.name} by sequence number"
            found[f"repeated_{channel.name}"] = f"sequence numbers seen twice on {channel.name}"
    return found


MEANINGS = _meanings()


def summarise(log: Log) -> dict[str, Value]:
    """All figures of a run: keys and meanings as in `MEANINGS`, None where the log has nothing to take one from."""
    found: dict[str, Value] = {"bench": log.bench, **_from_bench_file(log)}
    found |= _course(log) | _tracking(log) | _timing(log) | _latency(log) | _losses(log) | _plant(log) | _gate(log) | _clocks(log)
    found["recorder_dropped"] = None
    problems = evidence_problems(found)
    return {**found, "evidence_valid": not problems, "evidence_problems": "; ".join(problems)}


def evidence_problems(found: dict[str, Any]) -> list[str]:
    """What speaks against using a run as evidence, one line each."""
    late = found["plant_late_max_ms"]
    checks = (
        (found["track_s"] == 0, "nothing was tracked"),
        (late is not None and late > LATE_MAX_MS, f"the plant was late by {late or 0:.1f} ms (allowed: {LATE_MAX_MS:g} ms)"),
        (found["missing_cycle"] > 0, f"{found['missing_cycle']} cycle records are missing"),
        (found["missing_truth"] > 0, f"{found['missing_truth']} truth records are missing"),
        (bool(found["log_problems"]), "the log file is damaged or unfinished"),
        (found["clock_steps"] > 0, "a host's clock jumped"),
        (bool(found["silent_channels"]), f"a channel is silent: {found['silent_channels']}"),
    )
    return [text for bad, text in checks if bad]


def judged(log: Log) -> tuple[list[str], list[str]]:
    """What is wrong with a log's file, and what speaks against using its run as evidence; one line each."""
    try:
        against = evidence_problems(_course(log) | _losses(log) | _plant(log) | _clocks(log))
    except (KeyError, ValueError):  # a field that softloop has and the log's own definition has not
        against = ["its messages are of another definition, so that it cannot be judged"]
    return _problems(log), against


def _problems(log: Log) -> list[str]:
    if log.problems or log.finished:
        return log.problems
    return ["the log was repaired; its recorder did not end it, and what came after its last message is lost"]


def _bench_tables(log: Log) -> dict[str, Any]:
    try:
        return tomllib.loads(log.text("bench.toml"))
    except tomllib.TOMLDecodeError:
        return {}


def _from_bench_file(log: Log) -> dict[str, Value]:
    controller = _bench_tables(log).get("controller", {})
    names = {key: controller.get(key) for key in ("law", "trajectory")} if isinstance(controller, dict) else {}
    return {key: value if isinstance(value, str) else None for key, value in names.items()}


def _course(log: Log) -> dict[str, Value]:
    cycles, track = log["cycle"], tracked(log)
    return {
        "completed": bool((cycles["phase"] == metrics.PHASE_DONE).any()),
        "run_s": _seconds(cycles),
        "track_s": _seconds(track),
        "dwells": len(dwells(track)),
        "ticks": len(cycles),
        "ticks_skipped": int(metrics.while_armed(log, cycles)["skipped"].sum()),
        "inputs_invalid_ticks": int(np.count_nonzero(track["inputs_valid"] == 0)),
        "saturated_percent": float(np.mean(track["saturated"] != 0)) * 100.0 if len(track) else None,
        "mode_switches_per_s": metrics.switches_per_s(track, [(0, len(track))] if len(track) else []),
        "mode_switches_dwell_per_s": metrics.switches_per_s(track, dwells(track)),
    }


def _seconds(cycles: Any) -> float:
    return float(cycles["stamp_ns"][-1] - cycles["stamp_ns"][0]) * 1e-9 if len(cycles) else 0.0


def _tracking(log: Log) -> dict[str, Value]:
    found: dict[str, Value] = {}
    for kind, errors in (("truth", metrics.truth_errors(log)), ("sensor", metrics.sensor_errors(log))):
        found |= {f"{kind}_error_{name}": value for name, value in errors.figures().items()}
    pressure = metrics.pressure_errors_kpa(log)
    pressure = pressure[np.isfinite(pressure)]
    found["pressure_error_max_kpa"] = float(np.abs(pressure).max()) if pressure.size else None
    found["pressure_error_rms_kpa"] = float(np.sqrt(np.mean(pressure**2))) if pressure.size else None
    return found


def _timing(log: Log) -> dict[str, Value]:
    return {f"tick_late_{name}_us": value for name, value in spread(metrics.lateness_us(log)).items()}


def _latency(log: Log) -> dict[str, Value]:
    found: dict[str, Value] = {}
    for sensor in SENSORS:
        for hop, values in metrics.latencies_us(log, sensor).items():
            for name, value in spread(values, (50.0, 99.0)).items():
                found[f"latency_{sensor}_{hop}_{name}_us"] = value
    return found


def _losses(log: Log) -> dict[str, Value]:
    found: dict[str, Value] = {"messages": 0, "log_problems": "; ".join(_problems(log))}
    silent = metrics.fallen_silent(log).items()
    tables = _bench_tables(log)
    unheard = [f"{name} never heard" for name, table in SPOKEN_BY.items() if table in tables and not len(log[name])]
    found["silent_channels"] = "; ".join([*(f"{name} {seconds:.1f} s before the end" for name, seconds in silent), *unheard])
    total = 0
    for name, (messages, missing, repeated) in metrics.losses(log).items():
        found |= {f"messages_{name}": messages, f"missing_{name}": missing, f"repeated_{name}": repeated}
        total += messages
    found["messages"] = total
    return found


def _plant(log: Log) -> dict[str, Value]:
    truth = metrics.while_armed(log, log["truth"])
    if not len(truth):
        return {"plant_late_max_ms": None, "plant_deadline_misses": None}
    misses = truth["deadline_misses"]
    return {"plant_late_max_ms": float(truth["late_max_ns"].max()) * 1e-6, "plant_deadline_misses": int(misses[-1] - misses[0])}


def _clocks(log: Log) -> dict[str, Value]:
    words, events = log["clock"], log["event"]
    steps = (events["kind"] == constant("Event", "KIND_CLOCK")) & (events["code"] == constant("Event", "CLOCK_STEP"))
    worst_ms = float(words["uncertainty_ns"].max()) * 1e-6 if len(words) else None
    return {"clock_uncertainty_max_ms": worst_ms, "clock_steps": int(np.count_nonzero(steps))}


def _gate(log: Log) -> dict[str, Value]:
    events = log["event"]
    gate = events[(events["kind"] == constant("Event", "KIND_GATE")) & (events["source"] == constant("Event", "SOURCE_GATE"))]
    faults = gate[gate["code"] == constant("ValveStatus", "GATE_FAULT")]
    driver = events[events["kind"] == constant("Event", "KIND_DRIVER")]
    reasons = names_of("ValveStatus", "REASON_")
    return {
        "gate_faults": len(faults),
        "gate_fault_reasons": "; ".join(reasons.get(int(r), f"reason {r}") for r in faults["reason"]),
        "driver_watchdog_trips": int(np.count_nonzero(driver["code"] == constant("ValveStatus", "DRIVER_WATCHDOG"))),
        "events": len(events),
    }


def write_summary(run: Path | str, log: Log | None = None) -> dict[str, Value]:
    """Summarise a run's directory (or log file) and write `summary.json` beside its log; returns the figures.

    Raises BadFile when there is no log, or the summary cannot be written.
    """
    path = find_log(run)
    found = summarise(log if log is not None else open_run(path))
    found["recorder_dropped"] = _dropped([account_of(part) for part in parts_of(path)])
    target = path.parent / SUMMARY
    try:
        target.write_text(json.dumps(found, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise BadFile(f"{target}: cannot be written: {error.strerror or error}") from None
    return found


def _dropped(accounts: list[Path]) -> int | None:
    """What all recorders of a run dropped; None where one of them left no account."""
    try:
        contents = [json.loads(account.read_text(encoding="utf-8")) for account in accounts]
        return sum(int(content[key]) for content in contents for key in ("dropped_backlog", "dropped_storage", "malformed"))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def paper_figures(found: dict[str, Any]) -> tuple[str, Paper]:
    """Which of the paper's tests a run is like, and the paper's figures for it: with dwells T1, without T2."""
    return ("T1", PAPER_T1) if found["dwells"] else ("T2", PAPER_T2)


def shown(value: Value, digits: int = 2) -> str:
    """A figure as text; a dash where there is none."""
    if value is None or value == "":
        return NONE
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.{digits}f}" if isinstance(value, float) else str(value)


def table_rows(found: dict[str, Any]) -> list[tuple[str, str, str]]:
    """(what, value, remark) of the figures that matter most."""
    name, paper = paper_figures(found)
    best, steady = paper["ARC (C3)"]
    remark = f"paper's ARC on its {name}: {best}°"
    rows = [
        ("maximum dynamic error", f"{shown(found['truth_error_max_deg'])}°", f"true angle; {remark}"),
        (
            "steady error",
            f"{shown(found['truth_error_steady_deg'])}°",
            f"last 2 s of dwells; paper: {steady}°" if steady else "no dwells",
        ),
        ("RMS error", f"{shown(found['truth_error_rms_deg'])}°", "true angle"),
        ("maximum error, sensor", f"{shown(found['sensor_error_max_deg'])}°", "as the inclinometer measured"),
        (
            "mode switches",
            f"{shown(found['mode_switches_per_s'], 1)} /s",
            f"on dwells {shown(found['mode_switches_dwell_per_s'], 1)} /s",
        ),
        (
            "tick lateness",
            _spread_text(found, "tick_late", 1e-3, "ms"),
            f"{found['ticks_skipped']} of {found['ticks']} ticks skipped",
        ),
    ]
    for sensor, word in zip(SENSORS, ("pressure to coil", "angle to coil"), strict=True):
        last = TOTAL[0] if found[f"latency_{sensor}_{TOTAL[0]}_p50_us"] is not None else TO_BUS[0]
        rows.append(
            (
                word,
                _spread_text(found, f"latency_{sensor}_{last}", 1e-3, "ms"),
                "until applied" if last == TOTAL[0] else "until on the bus",
            )
        )
    missing = sum(found[f"missing_{c.name}"] for c in CHANNELS if c.logged)
    rows.append(("messages", f"{found['messages']}", f"{missing} missing; recorder dropped {shown(found['recorder_dropped'])}"))
    rows.append(("gate faults", str(found["gate_faults"]), found["gate_fault_reasons"]))
    rows.append(("plant late", f"{shown(found['plant_late_max_ms'])} ms", "worst; more than 2 ms is no evidence"))
    rows.append(("valid evidence", shown(found["evidence_valid"]), found["evidence_problems"]))
    return rows


def _spread_text(found: dict[str, Any], prefix: str, scale: float, unit: str) -> str:
    values = [found.get(f"{prefix}_{name}_us") for name in ("p50", "p99", "max")]
    return " / ".join(NONE if v is None else f"{v * scale:.2f}" for v in values) + f" {unit}"


def summary_table(found: dict[str, Any]) -> Table:
    """The table for the end of a run. Columns of three numbers are median / 99th percentile / maximum."""
    table = Table(
        title=f"{found['bench']}: {shown(found['law'])} on {shown(found['trajectory'])}, {found['track_s']:.1f} s tracked"
    )
    table.add_column("figure")
    table.add_column("value", justify="right")
    table.add_column("remark", style="dim")
    for what, value, remark in table_rows(found):
        style = "bold red" if what == "valid evidence" and not found["evidence_valid"] else None
        table.add_row(what, value, remark, style=style)
    return table
