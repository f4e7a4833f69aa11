"""What a run's log says in numbers: tracking, timing, latency hop by hop, modes, losses.

Pure functions of a `Log`; all stamps are ns of the rig clock, all errors are angle less reference.

The plant's truth and the sensor have stamps of their own. Truth is brought to the ticks' stamps by linear interpolation (its
samples lie 5 ms apart; at 5000 deg/s^2 that is right to 0.02 deg). A sensor sample is compared with the reference at the time
at which it was measured, again interpolated, so that its age is not counted as tracking error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softloop.offline.log import Log, Records
from softloop.wire.channels import CHANNELS
from softloop.wire.mcap_layout import SENDER_FIELDS
from softloop.wire.messages import constant

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

PHASE_TRACK = constant("CycleRecord", "PHASE_TRACK")
PHASE_DONE = constant("CycleRecord", "PHASE_DONE")
GATE_ARMED = constant("ValveStatus", "GATE_ARMED")
STEADY_S = 2.0  # the end of a dwell over which the steady error is taken
STILL_DEG_S = 1e-9  # a reference slower than this dwells; polynomials of a dwell give exactly zero
PERCENTILES = (50.0, 99.0, 99.9)
STEADY = tuple(c for c in CHANNELS if c.logged and c.rate_hz >= 100.0 and c.message != "CanFrame")
SILENT_S = 2.0  # processes end one after the other, but within this


@dataclass(frozen=True)
class Errors:
    """Tracking errors of one run against one measure of the angle.

    Attributes:
        time_s: (n,) time since the first sample of PHASE_TRACK.
        error_deg: (n,) angle less reference.
        steady: (n,) bool, within the last 2 s of a dwell.
    """

    time_s: Floats
    error_deg: Floats
    steady: NDArray[np.bool_]

    def figures(self) -> dict[str, float | None]:
        """Maximum, its time, RMS, and the steady error, None where there is nothing to take it from."""
        e = np.abs(self.error_deg)
        if not e.size or np.isnan(e).any():  # a law that follows no angle logs its reference as nan
            return {"max_deg": None, "max_at_s": None, "rms_deg": None, "steady_deg": None}
        return {
            "max_deg": float(e.max()),
            "max_at_s": float(self.time_s[e.argmax()]),
            "rms_deg": float(np.sqrt(np.mean(e * e))),
            "steady_deg": float(e[self.steady].max()) if self.steady.any() else None,
        }


def while_armed(log: Log, records: Records) -> Records:
    """Those of `records` whose stamp falls where the gate's last word was ARMED; all of them where no gate spoke.

    What happens before and after, while processes start and end, is no part of a run's evidence.
    """
    valves = log["valves"]
    if not len(valves):
        return records
    before = np.searchsorted(valves["stamp_ns"], records["stamp_ns"], side="right") - 1
    return records[(before >= 0) & (valves["gate"][np.maximum(before, 0)] == GATE_ARMED)]


def tracked(log: Log) -> Records:
    """The cycle records of PHASE_TRACK, all of them, from the first."""
    cycles = log["cycle"]
    return cycles[cycles["phase"] == PHASE_TRACK]


def interpolate(at_ns: Ints, stamps_ns: Ints, values: Floats) -> Floats:
    """Linear interpolation on int64 stamps, (n,); the first and last value outside them; nan where there are none."""
    if not len(stamps_ns):
        return np.full(len(at_ns), np.nan)
    start = stamps_ns[0]
    # Differences first: a float64 holds ns of a long-running clock only to some hundred ns.
    return np.interp((at_ns - start).astype(np.float64), (stamps_ns - start).astype(np.float64), values)


def runs_of(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """[start, end) of each stretch of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def dwells(cycles: Records) -> list[tuple[int, int]]:
    """[start, end) of each dwell among cycle records: stretches of at least 2 s in which the reference stands still."""
    found = runs_of(np.abs(cycles["reference_rate_deg_s"]) <= STILL_DEG_S)
    stamps = cycles["stamp_ns"]
    return [(a, b) for a, b in found if stamps[b - 1] - stamps[a] >= STEADY_S * 1e9]


def steady_spans_ns(cycles: Records) -> list[tuple[int, int]]:
    """First and last stamp of the last 2 s of every dwell."""
    stamps = cycles["stamp_ns"]
    return [(int(stamps[b - 1] - STEADY_S * 1e9), int(stamps[b - 1])) for _, b in dwells(cycles)]


def _within(stamps_ns: Ints, spans: list[tuple[int, int]]) -> NDArray[np.bool_]:
    inside = np.zeros(len(stamps_ns), bool)
    for first, last in spans:
        inside |= (stamps_ns >= first) & (stamps_ns <= last)
    return inside


def errors_at(stamps_ns: Ints, error_deg: Floats, cycles: Records) -> Errors:
    """Errors with their times and what is steady, from the cycle records of PHASE_TRACK."""
    start = cycles["stamp_ns"][0] if len(cycles) else 0
    return Errors((stamps_ns - start) * 1e-9, error_deg, _within(stamps_ns, steady_spans_ns(cycles)))


def truth_errors(log: Log) -> Errors:
    """The plant's true angle against the reference, at the ticks of PHASE_TRACK; empty without a plant."""
    cycles, truth = tracked(log), log["truth"]
    if not len(truth):
        cycles = cycles[:0]
    angle = interpolate(cycles["stamp_ns"], truth["stamp_ns"], truth["angle_deg"])
    return errors_at(cycles["stamp_ns"], angle - cycles["reference_deg"], cycles)


def sensor_errors(log: Log) -> Errors:
    """The inclinometer's samples within PHASE_TRACK against the reference at the time of each sample."""
    cycles, samples = tracked(log), log["inclination"]
    if not len(cycles):
        samples = samples[:0]
    else:
        first, last = cycles["stamp_ns"][0], cycles["stamp_ns"][-1]
        samples = samples[(samples["stamp_ns"] >= first) & (samples["stamp_ns"] <= last)]
    reference = interpolate(samples["stamp_ns"], cycles["stamp_ns"], cycles["reference_deg"])
    return errors_at(samples["stamp_ns"], samples["angle_deg"] - reference, cycles)


def pressure_errors_kpa(log: Log) -> Floats:
    """Chamber pressure less desired pressure at the ticks of PHASE_TRACK: the plant's where there is one, else measured."""
    cycles, truth = tracked(log), log["truth"]
    if len(truth):
        chamber = interpolate(cycles["stamp_ns"], truth["stamp_ns"], truth["chamber_pressure_kpa"])
    else:
        chamber = cycles["chamber_pressure_kpa"]
    return np.asarray(chamber - cycles["desired_pressure_kpa"], np.float64)


def spread(values: Floats, percentiles: tuple[float, ...] = PERCENTILES) -> dict[str, float | None]:
    """Percentiles as values that did occur (the next higher one), and the maximum: `p50`, `p99`, `p99_9`, `max`."""
    names = [f"p{p:g}".replace(".", "_") for p in percentiles]
    values = values[np.isfinite(values)]
    if not values.size:
        return dict.fromkeys([*names, "max"])
    found = np.percentile(values, percentiles, method="higher")
    return {**dict(zip(names, map(float, found), strict=True)), "max": float(values.max())}


def lateness_us(log: Log) -> Floats:
    """How late each tick woke, in us, (n,): all while the gate was armed."""
    cycles = while_armed(log, log["cycle"])
    return (cycles["woken_ns"] - cycles["stamp_ns"]) * 1e-3


# The way of a sample into the coil: name of a hop, its start and its end, in order.
HOPS = (
    ("wire", "sampled", "received"),  # sensor to adapter
    ("adapter", "received", "sent"),
    ("wait", "sent", "woken"),  # Zenoh, and waiting for the tick
    ("compute", "woken", "computed"),
    ("publish", "computed", "published"),
    ("zenoh", "published", "at_gate"),
    ("gate", "at_gate", "frame_sent"),
    ("frame", "frame_sent", "applied"),  # bus, frame time and the driver
)
TOTAL = ("total", "sampled", "applied")
TO_BUS = ("to_bus", "sampled", "frame_sent")
SENSORS = ("pressure", "inclination")


def latencies_us(log: Log, sensor: str) -> dict[str, Floats]:
    """Each hop of `HOPS`, `to_bus` and `total` in us, (n,) per tick; nan where a stamp of it is not in the log.

    A tick's chain: the newest sample that it used, its command, the first valve frame that answered this command, and the
    driver's word (the plant's) on that frame.
    """
    cycles = log["cycle"]
    points = {name: cycles[f"{name}_ns"].astype(np.float64) for name in ("woken", "computed", "published")}
    samples = log[sensor]
    for name, column in (("sampled", "stamp_ns"), ("received", "received_ns"), ("sent", "published_ns")):
        points[name] = _join(cycles[f"{sensor}_seq"], samples["seq"], samples[column])
    points |= _gate_points(log, cycles)
    return {name: (points[end] - points[start]) * 1e-3 for name, start, end in (*HOPS, TO_BUS, TOTAL)}


def _gate_points(log: Log, cycles: Records) -> dict[str, Floats]:
    commands, valves = log["command"], log["valves"]
    frames = valves[valves["command_seq"] > 0]
    first = np.unique(frames["command_seq"], return_index=True)[1]
    frames = frames[first]
    command_seq = _join(cycles["tick"], commands["tick"], commands["seq"])
    command_seq[~cycles["published_ns"].astype(bool)] = np.nan
    found = {
        "at_gate": _join(command_seq, frames["command_seq"], frames["command_received_ns"]),
        "frame_sent": _join(command_seq, frames["command_seq"], frames["stamp_ns"]),
    }
    found["applied"] = _join(command_seq, frames["command_seq"], applied_ns(frames["stamp_ns"], valves["stamp_ns"], log["truth"]))
    return found


def applied_ns(frames_ns: Ints, all_frames_ns: Ints, truth: Records) -> Floats:
    """When the driver applied each frame, (n,); nan where truth, sampled every 5 ms, did not see it.

    The frame that was applied is the one whose end on the wire lies between its own hand-over to the bus and the next one's.
    """
    if not len(truth) or not len(all_frames_ns):
        return np.full(len(frames_ns), np.nan)
    ends, at = np.unique(truth["command_end_ns"], return_index=True)
    applied = truth["command_applied_ns"][at].astype(np.float64)
    k = np.searchsorted(ends, frames_ns, side="left")
    known = k < len(ends)
    k = np.minimum(k, len(ends) - 1)
    ordered = np.sort(all_frames_ns)
    after = np.searchsorted(ordered, frames_ns, side="right")
    limit = np.append(ordered, np.iinfo(np.int64).max)[after]
    return np.where(known & (ends[k] <= limit), applied[k], np.nan)


def _join(wanted: NDArray[Any], keys: NDArray[Any], values: NDArray[Any]) -> Floats:
    """The value beside each wanted key (the last one where a key repeats), nan where there is none."""
    wanted = np.asarray(wanted, np.float64)
    if not len(keys):
        return np.full(len(wanted), np.nan)
    order = np.argsort(keys, kind="stable")
    known = np.asarray(keys, np.float64)[order]
    at = np.maximum(np.searchsorted(known, wanted, side="right") - 1, 0)
    return np.where(known[at] == wanted, values[order][at].astype(np.float64), np.nan)


def switches_per_s(cycles: Records, spans: list[tuple[int, int]]) -> float | None:
    """Changes of the working mode per second within [start, end) spans of cycle records; None without any."""
    modes, stamps = cycles["mode"], cycles["stamp_ns"]
    seconds = sum(float(stamps[b - 1] - stamps[a]) for a, b in spans) * 1e-9
    changes = sum(int(np.count_nonzero(np.diff(modes[a:b].astype(np.int16)))) for a, b in spans)
    return changes / seconds if seconds > 0 else None


def losses(log: Log) -> dict[str, tuple[int, int, int]]:
    """Channel -> messages, missing by sequence number, and numbers that came twice or backward; CAN taken together.

    Each sender counts for itself; what was sent before the first logged message is not counted as missing.
    """
    found = {c.name: _losses(log[c.name], c.message) for c in CHANNELS if c.logged and c.message != "CanFrame"}
    buses: dict[str, list[Records]] = {}
    for (bus, _), frames in log.can.items():
        buses.setdefault(bus, []).append(frames)
    of_buses = [_losses(np.concatenate(frames), "CanFrame") for frames in buses.values()]
    found["can"] = (sum(x[0] for x in of_buses), sum(x[1] for x in of_buses), sum(x[2] for x in of_buses))
    return found


def fallen_silent(log: Log) -> dict[str, float]:
    """Steady channels that end early: name -> seconds between their last message and the last of any of them.

    A break in the sequence numbers shows only where a later message comes; this shows where none does.
    """
    last = {c.name: int(log[c.name]["stamp_ns"][-1]) for c in STEADY if len(log[c.name])}
    end = max(last.values(), default=0)
    silent = {name: (end - stamp) * 1e-9 for name, stamp in last.items()}
    return {name: seconds for name, seconds in silent.items() if seconds > SILENT_S}


def _losses(records: Records, kind: str) -> tuple[int, int, int]:
    sender = SENDER_FIELDS.get(kind)
    groups = [records] if sender is None else [records[records[sender] == s] for s in np.unique(records[sender])]
    missing = repeated = 0
    for group in groups:
        if len(group):
            numbers = np.unique(group["seq"])
            missing += int(numbers[-1] - numbers[0]) + 1 - len(numbers)
            repeated += len(group) - len(numbers)
    return len(records), missing, repeated
