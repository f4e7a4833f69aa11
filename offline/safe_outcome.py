"""How a run under injected faults ended, and how soon, by the plant's truth.

VENT: no current in the charge valve, the exhaust open, and the charge current stays away to the end of the log.
DEAD: no current in either coil.
CONTINUE: up to the run's planned end the gate stayed armed and the driver did as it was told; then it vented as after any run.
TRAPPED: likewise, but after the planned end the exhaust did not open: pressure is held in, and software cannot let it out.
NONE: none of these.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softloop.offline.log import Log
from softloop.plant.truth import CHARGE_OFF_MA, EMPTY_KPA, EXHAUST_OPEN_MM2
from softloop.wire.messages import constant

Records = NDArray[Any]
VENT, DEAD, CONTINUE, TRAPPED, NONE = "VENT", "DEAD", "CONTINUE", "TRAPPED", "NONE"
GAP_NS = 50_000_000  # the truth comes every 5 ms
STEADY_NS = 100_000_000  # an exhaust that is open for less is one that is closing
_KIND_GATE, _KIND_FAULT = constant("Event", "KIND_GATE"), constant("Event", "KIND_FAULT")
_ARMED, _DRIVER_OK = constant("ValveStatus", "GATE_ARMED"), constant("ValveStatus", "DRIVER_OK")


@dataclass(frozen=True)
class SafeOutcome:
    """What was seen.

    Attributes:
        seen: VENT, DEAD, CONTINUE, TRAPPED or NONE.
        began_ns: rig clock of the first injection.
        from_ns: rig clock that both times count from: the first injection; of CONTINUE and TRAPPED, the planned end.
        chamber_kpa: chamber pressure then.
        vent_s: until the charge current is 0 and the exhaust open; None when that never is.
        empty_s: until the chamber is under 5 kPa for good; None when it never is.
    """

    seen: str
    began_ns: int
    from_ns: int
    chamber_kpa: float
    vent_s: float | None
    empty_s: float | None


def outcome_of(log: Log, armed_s: float) -> SafeOutcome | None:
    """What a run came to that was to be armed for `armed_s`; None when nothing was injected, or it was not armed."""
    events, truth = log["event"], log["truth"]
    came = events[(events["kind"] == _KIND_FAULT) & (events["code"] == 1)]
    armed = events[(events["kind"] == _KIND_GATE) & (events["code"] == _ARMED)]
    if not len(came) or not len(armed) or not len(truth):
        return None
    end_ns = int(armed["stamp_ns"].min()) + round(armed_s * 1e9)
    stayed = _last_word_of_gate(events, log["valves"], end_ns) == _ARMED
    return judge(bridged(truth), int(came["stamp_ns"].min()), end_ns, stayed_armed=stayed)


def _last_word_of_gate(events: Records, statuses: Records, end_ns: int) -> int | None:
    """The gate's state before `end_ns`, by its event or its status, whichever is newer: either may have been lost."""
    gates = events[(events["kind"] == _KIND_GATE) & (events["stamp_ns"] < end_ns)]
    words = [(int(e["stamp_ns"]), 1, int(e["code"])) for e in gates]
    said = statuses[statuses["stamp_ns"] < end_ns]
    if len(said):
        newest = said[np.argmax(said["stamp_ns"])]
        words.append((int(newest["stamp_ns"]), 0, int(newest["gate"])))
    return max(words)[2] if words else None


def bridged(truth: Records) -> Records:
    """The truth, with up to two more records in each gap: when the vent began, and when the chamber was empty.

    A recorder behind a network that was lost heard nothing meanwhile; what it hears next says since when both hold.
    """
    gaps = np.flatnonzero(np.diff(truth["stamp_ns"]) > GAP_NS)
    pieces, start = [], 0
    for place in gaps.tolist():
        pieces += [truth[start : place + 1], _in_gap(truth[place : place + 1], truth[place + 1 : place + 2])]
        start = place + 1
    return np.concatenate([*pieces, truth[start:]])


def _in_gap(before: Records, after: Records) -> Records:
    """The records, shape (n,) with n from 0 to 2, between two of shape (1,) of which the latter comes late."""
    vent_ns = max(int(after["charge_off_ns"][0]), int(after["exhaust_open_ns"][0]))
    empty_ns = int(after["empty_ns"][0])
    if not after["charge_off_ns"][0] or not after["exhaust_open_ns"][0]:
        return after[:0]
    made = []
    for at_ns in sorted({vent_ns, empty_ns}):
        if before["stamp_ns"][0] < at_ns < after["stamp_ns"][0]:
            made.append(after.copy())
            made[-1]["stamp_ns"] = at_ns
            if not 0 < empty_ns <= at_ns:
                made[-1]["chamber_pressure_kpa"] = before["chamber_pressure_kpa"]
    return np.concatenate(made) if made else after[:0]


def judge(truth: Records, began_ns: int, end_ns: int, *, stayed_armed: bool) -> SafeOutcome:
    """The outcome from the records of `PlantTruth`, shape (n,), for an injection at `began_ns` and a planned end at `end_ns`.

    A controller that lets air out shortly before the planned end looks like a vent; that the gate was armed (`stayed_armed`) and
    the driver heard it says that it is none. A gate that is killed says nothing any more: then the driver's watchdog has come.
    """
    before_end = truth["driver"][truth["stamp_ns"] < end_ns]
    if stayed_armed and len(before_end) and before_end[-1] == _DRIVER_OK:
        vent_ns = vented_from(truth, end_ns)
        return _timed(truth, TRAPPED if vent_ns is None else CONTINUE, began_ns, end_ns, vent_ns)
    vent_ns, dead_ns = vented_from(truth, began_ns), dead_from(truth, began_ns)
    if vent_ns is not None and vent_ns < end_ns:
        return _timed(truth, VENT, began_ns, began_ns, vent_ns)
    if dead_ns is not None and dead_ns < end_ns and vent_ns is None:
        return _timed(truth, DEAD, began_ns, began_ns, None)
    return _timed(truth, NONE, began_ns, began_ns, vent_ns)


def vented_from(truth: Records, after_ns: int) -> int | None:
    """When the charge current was 0 for good and the exhaust open, for longer than a valve needs to close; None: never."""
    stamps = truth["stamp_ns"]
    for_good = stamps > _last(stamps, truth["charge_coil_ma"] >= CHARGE_OFF_MA)
    venting = for_good & (stamps >= after_ns) & (truth["exhaust_area_mm2"] > EXHAUST_OPEN_MM2)
    for first in np.flatnonzero(venting & ~np.r_[False, venting[:-1]]):
        closed = np.flatnonzero(~venting[first:])
        until_ns = stamps[first + closed[0]] if len(closed) else stamps[-1]
        if until_ns - stamps[first] >= STEADY_NS:
            return int(stamps[first])
    return None


def dead_from(truth: Records, after_ns: int) -> int | None:
    """From when on neither coil had a current, to the end; None: never."""
    current = (truth["charge_coil_ma"] >= CHARGE_OFF_MA) | (truth["exhaust_coil_ma"] >= CHARGE_OFF_MA)
    return _first(truth["stamp_ns"], truth["stamp_ns"] > max(_last(truth["stamp_ns"], current), after_ns))


def empty_from(truth: Records, after_ns: int) -> int | None:
    """From when on the chamber was under 5 kPa, to the end; None: never."""
    stamps = truth["stamp_ns"]
    last_ns = _last(stamps, truth["chamber_pressure_kpa"] >= EMPTY_KPA)
    return _first(stamps, (stamps > last_ns) & (stamps >= after_ns))


def _timed(truth: Records, seen: str, began_ns: int, from_ns: int, vent_ns: int | None) -> SafeOutcome:
    at = min(int(np.searchsorted(truth["stamp_ns"], from_ns)), len(truth) - 1)
    empty_ns = empty_from(truth, from_ns)
    vent_s = None if vent_ns is None else 1e-9 * (vent_ns - from_ns)
    empty_s = None if empty_ns is None else 1e-9 * (empty_ns - from_ns)
    return SafeOutcome(seen, began_ns, from_ns, float(truth["chamber_pressure_kpa"][at]), vent_s, empty_s)


def _last(stamps: Records, mask: NDArray[np.bool_]) -> int:
    """The stamp of the last record in `mask`; -1 when there is none."""
    return int(stamps[mask][-1]) if mask.any() else -1


def _first(stamps: Records, mask: NDArray[np.bool_]) -> int | None:
    return int(stamps[mask][0]) if mask.any() else None
