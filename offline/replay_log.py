"""A log as a replay needs it: for each tick its record, the samples that it saw, its command, and what of these is missing."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softloop.controller.records import CYCLE, INPUTS
from softloop.offline.log import Log, Records
from softloop.wire.errors import BadFile
from softloop.wire.messages import message

# What is done for a tick: run it; run it from the state of a new process; or take over the state that its record shows.
RUN, BEGIN, RECALL = 0, 1, 2
# Why the state is taken over, one bit each.
LOG_BEGINS, RECORDS_MISSING, PRESSURE_MISSING, INCLINATION_MISSING, VALVES_MISSING = 1, 2, 4, 8, 16

_COMMAND = message("ValveCommand").dtype
_NEEDED = ["seq", "stamp_ns", "tick", "skipped", "phase", "computed_ns", "internal", "theta"]
_NEEDED += [f"{called}_{part}" for called in ("pressure", "inclination", "valve") for part in ("seq", "stamp_ns")]
# Field of `INPUTS` and channel, what the cycle record calls it, and the bit that says it is missing.
_SAMPLES = (
    ("pressure", "pressure", PRESSURE_MISSING),
    ("inclination", "inclination", INCLINATION_MISSING),
    ("valves", "valve", VALVES_MISSING),
)
_SAID = {
    PRESSURE_MISSING: "the pressure sample is not in the log",
    INCLINATION_MISSING: "the inclination sample is not in the log",
    VALVES_MISSING: "the valve status is not in the log",
}


@dataclass(frozen=True)
class Stretch:
    """Ticks next to each other that cannot be compared: how many have a record, how many have none, and why."""

    first_tick: int
    last_tick: int
    recorded: int
    unrecorded: int
    why: str


@dataclass(frozen=True)
class LoggedRun:
    """What was logged of the controller, n ticks.

    Attributes:
        cycles: (n,) records as this installation lays them out.
        commands: (n,) of `ValveCommand`; `answered` (n,) says where the log holds it.
        action: (n,) of RUN, BEGIN, RECALL.
        stretches: the ticks with RECALL, and why.
        restarts: ticks with which the controller began anew within the log.
        absent: fields of today's records that the log does not have, such as "cycle.skipped".
    """

    cycles: Records
    commands: Records
    answered: NDArray[np.bool_]
    action: NDArray[np.uint8]
    stretches: list[Stretch]
    restarts: list[int]
    absent: list[str]
    _samples: dict[str, Records]
    _places: dict[str, NDArray[np.int64]]

    def inputs(self, part: slice) -> Records:
        """`INPUTS` records of some ticks: the very messages that each tick saw."""
        cycles = self.cycles[part]
        inputs = np.zeros(len(cycles), INPUTS)
        inputs["now_ns"], inputs["tick"], inputs["skipped"] = cycles["stamp_ns"], cycles["tick"], cycles["skipped"]
        for name, samples in self._samples.items():
            inputs[name] = samples[self._places[name][part]]
        return inputs


def read_run(log: Log) -> LoggedRun:
    """Put a log in order for a replay. Raises BadFile when it holds no ticks, or ticks without what a replay needs."""
    absent: list[str] = []
    cycles = _as_today(log["cycle"], CYCLE, "cycle", absent)
    lacking = [f for f in _NEEDED if f"cycle.{f}" in absent]
    if not len(cycles) or lacking:
        missing = f"its cycle records have no {', '.join(lacking)}" if lacking else "it holds no cycle record of a controller"
        raise BadFile(f"{log.path}: cannot be replayed: {missing}")
    samples, places = {}, {}
    why = _breaks(cycles)
    for name, called, bit in _SAMPLES:
        logged = _as_today(log[name], INPUTS[name], name, absent)
        samples[name] = np.append(logged, np.zeros(1, logged.dtype))
        places[name] = _find(logged, cycles[f"{called}_seq"], cycles[f"{called}_stamp_ns"])
        nothing_came = (cycles[f"{called}_seq"] == 0) & (cycles[f"{called}_stamp_ns"] == 0)
        why[(places[name] < 0) & ~nothing_came] |= bit
    commands = _as_today(log["command"], _COMMAND, "command", absent)
    answer = _find(commands, cycles["seq"], cycles["computed_ns"])
    begins = (cycles["seq"] == 1) & (why == 0)
    action = np.where(why != 0, RECALL, np.where(begins, BEGIN, RUN)).astype(np.uint8)
    restarts = cycles["tick"][np.flatnonzero(cycles["seq"][1:] == 1) + 1].tolist()
    asked = np.append(commands, np.zeros(1, _COMMAND))[answer]
    return LoggedRun(cycles, asked, answer >= 0, action, _stretches(cycles, why), restarts, absent, samples, places)


def _as_today(logged: Records, dtype: np.dtype[Any], name: str, absent: list[str]) -> Records:
    """The records in today's layout, field by field; a field that the log does not have is zero and goes to `absent`."""
    if logged.dtype == dtype:
        return logged
    made = np.zeros(len(logged), dtype)
    for field in dtype.names or ():
        if field in (logged.dtype.names or ()) and logged.dtype[field] == dtype[field]:
            made[field] = logged[field]
        else:
            absent.append(f"{name}.{field}")
    return made


def _breaks(cycles: Records) -> NDArray[np.uint8]:
    """(n,) of LOG_BEGINS or RECORDS_MISSING where the record before is not there, else 0."""
    seq = cycles["seq"].astype(np.int64)
    why = np.zeros(len(seq), np.uint8)
    why[1:][(np.diff(seq) != 1) & (seq[1:] != 1)] = RECORDS_MISSING
    why[0] = LOG_BEGINS if seq[0] != 1 else 0
    return why


def _find(records: Records, seq: NDArray[Any], stamp_ns: NDArray[Any]) -> NDArray[np.int64]:
    """(n,) places in `records` of the messages with these numbers and stamps; -1 where there is none.

    By both, because a sender that was started again counts from 1 again.
    """
    if not len(records):
        return np.full(len(seq), -1)
    order = np.lexsort((records["seq"], records["stamp_ns"]))
    seqs, stamps = records["seq"][order], records["stamp_ns"][order]
    at = np.searchsorted(stamps, stamp_ns)
    last = len(order) - 1
    while True:
        here = np.minimum(at, last)
        other = (at <= last) & (stamps[here] == stamp_ns) & (seqs[here] != seq)
        if not other.any():
            break
        at = at + other
    found = (at <= last) & (stamps[here] == stamp_ns)
    return np.where(found, order[here], -1)


def _stretches(cycles: Records, why: NDArray[np.uint8]) -> list[Stretch]:
    """Ticks with the same reason next to each other as one; a gap in the records always begins a new one."""
    changed = np.ones(len(why), bool)
    changed[1:] = (why[1:] != why[:-1]) | ((why[1:] & (LOG_BEGINS | RECORDS_MISSING)) != 0)
    starts = np.append(np.flatnonzero(changed), len(why)).tolist()
    return [_stretch(cycles, s, e, int(why[s])) for s, e in pairwise(starts) if why[s]]


def _stretch(cycles: Records, start: int, end: int, why: int) -> Stretch:
    first, last = int(cycles["tick"][start]), int(cycles["tick"][end - 1])
    reasons = [text for bit, text in _SAID.items() if why & bit]
    unrecorded = 0
    if why & (LOG_BEGINS | RECORDS_MISSING):
        seq, before = int(cycles["seq"][start]), int(cycles["seq"][start - 1]) if why & RECORDS_MISSING else 0
        unrecorded = seq - 1 - (before if before < seq else 0)
        where = "before the log begins" if why & LOG_BEGINS else "here"
        counted = "1 cycle record" if unrecorded == 1 else f"{unrecorded} cycle records"
        reasons.insert(0, f"{counted} {where} not in the log")
    return Stretch(first, last, end - start, unrecorded, "; ".join(reasons))
