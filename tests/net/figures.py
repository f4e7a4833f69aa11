"""What a run on a network came to, in figures out of its log, and whether that keeps the bounds. Pure but for reading the log."""

from dataclasses import dataclass, field

import numpy as np

from softloop.offline.metrics import tracked
from softloop.offline.run_log import open_run
from softloop.offline.summary import PAPER_T2, summarise
from softloop.wire.channels import CHANNELS
from softloop.wire.messages import constant
from tests.net.hosts import AHEAD_S, LEADER

PAPER_T2_DEG = PAPER_T2["ARC (C3)"][0]  # what the paper's best controller reached, with no network in its loop
LATE_P99_US = 2500.0  # half a tick
SKIPPED = 0.01  # of all ticks
INSIDE = 0.95  # of a clock's samples: the true offset within the stated uncertainty
AGE_MS = 12.0  # of a pressure at the tick that uses it, half of them, without the network: a period, the wire, two wake-ups
COIL_OFF_MA = 1.0
# From a FAULT to no current in the charge coil, as the log can show it: the bus, 4.3 lags of 1.5 ms from 75 to 1 mA, and the
# period of the plant's truth.
OFF_MS = 1.0 + 4.3 * 1.5 + 5.0
KIND_GATE, FAULT = constant("Event", "KIND_GATE"), constant("ValveStatus", "GATE_FAULT")
ARMED = constant("ValveStatus", "GATE_ARMED")
KEYS = ("track_s", "truth_error_max_deg", "truth_error_rms_deg", "tick_late_p50_us", "tick_late_p99_us", "tick_late_p99_9_us",
        "tick_late_max_us", "ticks", "ticks_skipped", "gate_faults", "gate_fault_reasons", "missing_cycle", "missing_truth",
        "plant_late_max_ms", "evidence_problems", "silent_channels", "latency_pressure_total_p50_us",
        "latency_pressure_total_p99_us")  # fmt: skip


@dataclass
class Cell:
    """One run: what the network was told to be, what the run came to, and which bounds it did not keep."""

    network: dict
    codes: dict
    figures: dict = field(default_factory=dict)
    clocks: dict = field(default_factory=dict)
    relay: dict = field(default_factory=dict)
    failed: list = field(default_factory=list)

    @property
    def outcome(self):
        if not self.figures:
            return "no log"
        if self.figures["gate_faults"]:
            return "vented"
        if not any(self.codes.values()):
            return "armed"
        return "ended" if self.figures["was_armed"] else "not armed"


def read(run_dir):
    """Figures and clocks of a run's directory."""
    log = open_run(run_dir)
    summary = summarise(log)
    figures = {key: summary[key] for key in KEYS} | {"off_ms": off_ms(log)}
    figures["was_armed"] = ARMED in {state for _, state in gate_events(log)}
    figures["charge_max_ma"] = float(log["truth"]["charge_coil_ma"].max(initial=0.0))
    track = tracked(log)
    for what in ("pressure", "inclination"):
        ages_ms = track[f"{what}_age_ns"] * 1e-6
        figures[f"{what}_age_p50_ms"], figures[f"{what}_age_p99_ms"] = (
            (float(np.percentile(ages_ms, q)) if len(ages_ms) else None) for q in (50, 99)
        )
    return figures, clocks(log["clock"])


def off_ms(log):
    """From the gate's first FAULT until the charge coil was without current, in the plant's truth; None without a FAULT."""
    events = log["event"][(log["event"]["kind"] == KIND_GATE) & (log["event"]["code"] == FAULT)]
    if not len(events):
        return None
    truth = log["truth"][log["truth"]["stamp_ns"] >= events["stamp_ns"][0]]
    off = truth[truth["charge_coil_ma"] < COIL_OFF_MA]
    return float((off["stamp_ns"][0] - events["stamp_ns"][0]) * 1e-6) if len(off) else float("inf")


def clocks(words):
    """Per host: how far its clock was from the leader's really, how sure it said that it was, and how often that held."""
    found = {}
    for number, name in enumerate(sorted(AHEAD_S)):
        of_host = words[words["host"] == number]
        if name == LEADER or not len(of_host):
            continue
        true_ns = (AHEAD_S[LEADER] - AHEAD_S[name]) * 1_000_000_000
        error_ns = np.abs(of_host["offset_ns"] - true_ns)
        found[name] = {
            "inside": float((error_ns <= of_host["uncertainty_ns"]).mean()),
            "error_p50_ms": float(np.median(error_ns) * 1e-6),
            "error_max_ms": float(error_ns.max() * 1e-6),
            "uncertainty_p50_ms": float(np.median(of_host["uncertainty_ns"]) * 1e-6),
            "words": len(of_host),
        }
    return found


def failures(cell: Cell):
    """The bounds that a cell does not keep, one line each.

    Without loss the rig stays armed and tracks as well as the paper's. Where packets are lost it may vent instead, if it did so
    at once: a packet lost twice is later than any budget. Or it does not arm at all, without any current.
    """
    if not cell.figures:
        return [f"no log; the hosts ended with {cell.codes}"]
    f, delay_ms = cell.figures, cell.network["delay_ms"] + cell.network["jitter_ms"]
    checks = [
        (f["silent_channels"], f"the recorder lost a channel: {f['silent_channels']}"),
        (len(cell.clocks) != len(AHEAD_S) - 1, f"clocks are known of {sorted(cell.clocks)} alone"),
        *((c["inside"] < INSIDE, f"{n}: true offset inside in {c['inside']:.1%}") for n, c in cell.clocks.items()),
        ((f["tick_late_p99_us"] or 0.0) > LATE_P99_US, f"99 % of ticks late by up to {f['tick_late_p99_us']} us"),
        (f["ticks_skipped"] > SKIPPED * f["ticks"], f"{f['ticks_skipped']} of {f['ticks']} ticks skipped"),
    ]
    if cell.outcome == "vented" and cell.network["loss"]:
        checks.append((f["off_ms"] > OFF_MS, f"vented {f['off_ms']:.1f} ms after the FAULT"))
        return [text for bad, text in checks if bad]
    if cell.outcome == "not armed" and cell.network["loss"]:
        checks.append((f["charge_max_ma"] > COIL_OFF_MA, f"{f['charge_max_ma']:.1f} mA in the charge coil, never armed"))
        return [text for bad, text in checks if bad]
    checks += [
        (any(cell.codes.values()) or f["gate_faults"], f"exit codes {cell.codes}, FAULT: {f['gate_fault_reasons'] or 'none'}"),
        (not (f["truth_error_max_deg"] or np.inf) <= PAPER_T2_DEG, f"off by up to {f['truth_error_max_deg']} deg"),
        *(_wrong_age(f[f"{what}_age_p50_ms"], delay_ms, what) for what in ("pressure", "inclination")),
    ]
    return [text for bad, text in checks if bad]


def _wrong_age(age_ms, delay_ms, what):
    """A clock that is not corrected, by 1000 s here, shows in every age."""
    return not delay_ms * 0.5 <= (np.inf if age_ms is None else age_ms) <= delay_ms + AGE_MS, f"half of {what} ages: {age_ms} ms"


LOGGED = [c.name for c in CHANNELS if c.logged and c.rate_hz >= 100.0 and c.name != "can"]


def first_after(log, at_ns):
    """Channel -> s from `at_ns` (rig clock) to its first sample after it, of the steady channels; inf where there is none."""
    found = {}
    for name in LOGGED:
        stamps = log[name]["stamp_ns"]
        later = stamps[stamps > at_ns]
        found[name] = float(later[0] - at_ns) * 1e-9 if len(later) else float("inf")
    return found


def gate_events(log):
    """(stamp_ns, state) of the gate's transitions, in order."""
    events = log["event"][log["event"]["kind"] == KIND_GATE]
    return [(int(e["stamp_ns"]), int(e["code"])) for e in events]
