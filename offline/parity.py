"""`softloop parity`: two runs of one excitation, channel by channel, against bounds.

Both are brought to the time on their trajectory, every 5 ms: samples stand at the stamps at which they were measured, so that
what a device or a wire adds to its delay shows. B is judged as a copy of A.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softloop.offline import metrics
from softloop.offline.log import Log
from softloop.offline.parity_bounds import ChannelBounds, ExcitationConfig, ParityBounds
from softloop.offline.spectra import SEGMENTS_LEAST, Estimate, estimate
from softloop.wire.errors import BadConfig, BadFile

Floats = NDArray[np.float64]
RATE_HZ = 200.0


@dataclass(frozen=True)
class Signal:
    """A channel of parity: its name, which is that of its table of bounds, and where it stands in a log."""

    name: str
    unit: str
    channel: str
    field: str
    stamp: str = "stamp_ns"


SIGNALS = (
    Signal("angle", "deg", "inclination", "angle_deg"),
    Signal("rate", "deg/s", "inclination", "rate_deg_s"),
    Signal("chamber_pressure", "kPa", "pressure", "chamber_pressure_kpa"),
    Signal("supply_pressure", "kPa", "pressure", "supply_pressure_kpa"),
    Signal("charge_current", "mA", "valves", "charge_current_ma"),
    Signal("exhaust_current", "mA", "valves", "exhaust_current_ma"),
    Signal("charge_coil", "mA", "valves", "charge_coil_ma", "driver_stamp_ns"),
    Signal("exhaust_coil", "mA", "valves", "exhaust_coil_ma", "driver_stamp_ns"),
)


@dataclass(frozen=True)
class Drive:
    """What a run was excited by, over the time on its trajectory.

    Attributes:
        law: the controller's.
        kind: field of the cycle record that holds the reference; "commands" where the law follows none.
        zero_ns: rig clock at the trajectory's start.
        time_s: (n,) of each tick, from the trajectory's start.
        values: name -> (n,), in the unit of the name.
    """

    law: str
    kind: str
    zero_ns: int
    time_s: Floats
    values: dict[str, Floats]


@dataclass(frozen=True)
class Compared:
    """One channel: both runs at `Parity.time_s`, what was estimated, and why it fails, a line each."""

    signal: Signal
    a: Floats
    b: Floats
    found: Estimate
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Parity:
    """Two runs, compared. `time_s`: (n,) on the trajectory."""

    kind: str
    time_s: Floats
    channels: tuple[Compared, ...]

    @property
    def passed(self) -> bool:
        return not any(one.reasons for one in self.channels)


def drive_of(log: Log) -> Drive:
    """What a run was excited by. Raises BadFile when it followed no trajectory."""
    track = metrics.tracked(log)
    if len(track) < 2:
        raise BadFile(f"{log.path}: no trajectory was followed, so there is nothing to compare")
    kind = next((f for f in ("reference_deg", "desired_pressure_kpa") if np.isfinite(track[f]).all()), "commands")
    names = (kind,) if kind != "commands" else ("charge_current_ma", "exhaust_current_ma")
    time_s = np.asarray(track["trajectory_ns"] * 1e-9, np.float64)
    zero_ns = int(track["stamp_ns"][0] - track["trajectory_ns"][0])
    return Drive(law_of(log), kind, zero_ns, time_s, {name: np.asarray(track[name], np.float64) for name in names})


def law_of(log: Log) -> str:
    """The law in the bench file of a log; empty when that does not say."""
    try:
        controller = tomllib.loads(log.text("bench.toml")).get("controller", {})
    except tomllib.TOMLDecodeError:
        return ""
    return str(controller.get("law", "")) if isinstance(controller, dict) else ""


def common_time(a: Drive, b: Drive, bounds: ParityBounds) -> Floats:
    """The times that both runs have, every 5 ms. Raises BadConfig when they are too few for the spectra."""
    first_s, last_s = max(a.time_s[0], b.time_s[0]), min(a.time_s[-1], b.time_s[-1])
    needed_s = SEGMENTS_LEAST * bounds.estimate.segment_s
    count = int(max(0.0, last_s - first_s) * RATE_HZ) + 1
    if count < SEGMENTS_LEAST * round(bounds.estimate.segment_s * RATE_HZ):
        raise BadConfig(
            f"the runs have {max(0.0, last_s - first_s):.1f} s of their trajectory in common, and spectra of segments of "
            f"{bounds.estimate.segment_s:g} s need {needed_s:g} s (key 'estimate.segment_s' of the bounds)"
        )
    return first_s + np.arange(count) / RATE_HZ


def check_excitation(a: Drive, b: Drive, time_s: Floats, config: ExcitationConfig) -> None:
    """Raise BadConfig, with one line that says what differs, unless both runs were excited alike."""
    refused = "these are not runs of one excitation: "
    if a.law != b.law:
        raise BadConfig(f"{refused}their laws are '{a.law}' and '{b.law}'")
    if a.kind != b.kind:
        raise BadConfig(f"{refused}one follows {a.kind} and the other {b.kind}")
    for name, values in a.values.items():
        limit = _tolerance(name, a.kind, config)
        apart = np.abs(np.interp(time_s, a.time_s, values) - np.interp(time_s, b.time_s, b.values[name]))
        over = apart > limit
        if 100.0 * over.mean() > config.differs_max_percent:
            raise BadConfig(
                f"{refused}{name} differs by up to {apart.max():.4g}, by more than {limit:g} in {100.0 * over.mean():.1f} % of "
                f"the time, first {time_s[over.argmax()]:.2f} s into the trajectory"
            )


def _tolerance(name: str, kind: str, config: ExcitationConfig) -> float:
    if kind == "commands":
        return config.command_max_ma
    return config.reference_max_deg if name.endswith("_deg") else config.reference_max_kpa


def sampled(log: Log, drive: Drive, one: Signal, time_s: Floats) -> Floats:
    """A channel at times on the trajectory, (n,), linear between samples. Raises BadFile when it was not measured all along."""
    records = log[one.channel]
    stamps, values = np.asarray(records[one.stamp], np.int64), np.asarray(records[one.field], np.float64)
    good = np.isfinite(values)
    stamps, places = np.unique(stamps[good], return_index=True)
    at_s = (stamps - drive.zero_ns) * 1e-9
    if not len(stamps) or at_s[0] > time_s[0] + 1.0 or at_s[-1] < time_s[-1] - 1.0:
        raise BadFile(f"{log.path}: {one.channel}.{one.field} was not measured over the whole trajectory")
    return np.interp(time_s, at_s, values[good][places])


def compare_runs(a: Log, b: Log, bounds: ParityBounds) -> Parity:
    """Two runs against bounds. Raises BadFile on a log that holds too little, BadConfig where they are not of one excitation."""
    drive_a, drive_b = drive_of(a), drive_of(b)
    time_s = common_time(drive_a, drive_b, bounds)
    check_excitation(drive_a, drive_b, time_s, bounds.excitation)
    channels = []
    for one in SIGNALS:
        x, y = sampled(a, drive_a, one, time_s), sampled(b, drive_b, one, time_s)
        found = estimate(x, y, RATE_HZ, bounds.estimate)
        channels.append(Compared(one, x, y, found, reasons(one, found, bounds.of(one.name))))
    return Parity(drive_a.kind, time_s, tuple(channels))


def reasons(one: Signal, found: Estimate, bounds: ChannelBounds) -> tuple[str, ...]:
    """Why a channel fails, a line each; empty when it does not. What is bounded and cannot be estimated fails."""
    said: list[str] = []

    def check(what: str, value: float | None, bound: float | None, shown: str, *, least: bool = False) -> None:
        if bound is None:
            return
        if value is None:
            said.append(f"{what} cannot be estimated, and has a bound: the channel is not excited, or not coherent")
        elif value < bound if least else value > bound:
            said.append(shown)

    limit = bounds.residual_rms_max
    shown = f"residual {found.residual_rms:.3g} {one.unit} RMS (mean {found.offset:+.3g}), bound {limit} {one.unit}"
    check("residual", found.residual_rms, limit, shown)
    check("coherence", found.coherence, bounds.coherence_min, _coherence_words(found, bounds), least=True)
    late = None if found.delay_ms is None else abs(found.delay_ms)
    check("delay", late, bounds.delay_max_ms, _delay_words(found, bounds))
    off = None if found.gain is None else 100.0 * abs(found.gain - 1.0)
    check("gain", off, bounds.gain_error_max_percent, _gain_words(found, bounds))
    return tuple(said)


def _coherence_words(found: Estimate, bounds: ChannelBounds) -> str:
    return f"coherence {found.coherence or 0.0:.4f}, bound {bounds.coherence_min}: B is not a filtered A"


def _delay_words(found: Estimate, bounds: ChannelBounds) -> str:
    delay = found.delay_ms or 0.0
    return f"delay {delay:+.2f} ms, bound {bounds.delay_max_ms} ms: B {'trails' if delay > 0 else 'leads'} A"


def _gain_words(found: Estimate, bounds: ChannelBounds) -> str:
    gain = found.gain or 0.0
    return f"gain {gain:.4f}, bound 1 +- {bounds.gain_error_max_percent} %: B moves {'more' if gain > 1 else 'less'} than A"


def as_dict(parity: Parity) -> dict[str, Any]:
    """What programs read."""
    return {
        "passed": parity.passed,
        "excitation": parity.kind,
        "seconds": float(parity.time_s[-1] - parity.time_s[0]),
        "channels": {
            one.signal.name: {"unit": one.signal.unit, **vars(one.found), "reasons": list(one.reasons)} for one in parity.channels
        },
    }
