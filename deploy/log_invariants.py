"""`softloop log invariants`: the monitor's own judgement on the cycle records of a log, whatever pace it was made at."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from softloop.deploy.bench import monitor_process
from softloop.offline.log import Log
from softloop.offline.replay import logged_controller, logged_parameters, logged_table
from softloop.offline.run_log import open_run
from softloop.watch.config import MonitorConfig
from softloop.watch.invariants import Limits, Memory, judge
from softloop.watch.monitor import limits_of
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK
from softloop.wire.messages import names_of

NAMES = names_of("Event", "INVARIANT_")


class Row(NamedTuple):
    """The fields of a cycle record that `judge` reads, as plain numbers."""

    tick: int
    stamp_ns: int
    phase: int
    mode: int
    theta: list[float]
    charge_current_ma: float
    exhaust_current_ma: float
    error_deg: float
    s1_deg_s: float
    s2_kpa: float
    desired_pressure_kpa: float
    saturated: int
    inputs_valid: int


def rows_of(cycles: Any) -> Iterator[Row]:
    """An array of cycle records, (n,), one by one."""
    return (Row(*values) for values in zip(*(cycles[name].tolist() for name in Row._fields), strict=True))


def violations(limits: Limits, cycles: Any) -> list[dict[str, Any]]:
    """Every stretch of ticks on which an invariant does not hold: name, first and last tick, how many ticks, the worst value."""
    memory = Memory()
    found: list[dict[str, Any]] = []
    open_at: dict[int, dict[str, Any]] = {}
    for row in rows_of(cycles):
        memory, verdicts = judge(limits, memory, row)
        named = {verdict.invariant: verdict.value for verdict in verdicts}
        for number, value in named.items():
            stretch = open_at.get(number)
            if stretch is None:
                stretch = open_at[number] = {"invariant": NAMES[number], "first_tick": row.tick, "ticks": 0, "worst": value}
                found.append(stretch)
            stretch["last_tick"], stretch["ticks"] = row.tick, stretch["ticks"] + 1
            stretch["worst"] = max(stretch["worst"], value, key=abs)
        open_at = {number: stretch for number, stretch in open_at.items() if number in named}
    return found


def limits_of_log(log: Log) -> Limits:
    """The limits that the bench in a log asks for; the defaults where it has no `[monitor]`. Raises BadFile or BadConfig."""
    process = monitor_process(logged_table(log, "monitor", MonitorConfig), logged_controller(log))
    return limits_of(process, logged_parameters(log))


def check_invariants(run: Path, *, as_json: bool) -> int:
    """Say which invariants do not hold in a log; EXIT_NEGATIVE when one does not. Raises BadFile or BadConfig."""
    log = open_run(run)
    found = violations(limits_of_log(log), log["cycle"])
    ticks = len(log["cycle"])
    if as_json:
        print(json.dumps({"log": str(log.path), "ticks": ticks, "violations": found}, indent=2))
        return EXIT_NEGATIVE if found else EXIT_OK
    print(f"{log.path}: {ticks} ticks, {'not every invariant holds' if found else 'every invariant holds'}")
    for s in found:
        where = f"ticks {s['first_tick']} to {s['last_tick']}, {s['ticks']} of them"
        print(f"  {s['invariant']}: {where}, worst {s['worst']:.4g}")
    return EXIT_NEGATIVE if found else EXIT_OK
