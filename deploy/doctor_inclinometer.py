"""What the doctor says of the inclinometer: rate, gaps, packets thrown away, and an angle that can be. Nothing is sent to it."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

from softloop.deploy.bench import Bench, process_config
from softloop.deploy.doctor_check import Check, Verdict, judged, worst
from softloop.devices.config import InclinometerConfig, sampler_bounds
from softloop.devices.inclinometer_setup import SerialSource
from softloop.devices.protocols import wt931
from softloop.devices.protocols.quantise import counts_to_deg, mounted_deg
from softloop.wire.clock import Clock
from softloop.wire.errors import Lost, Unavailable

NAME = "inclinometer"
WAIT_S = 0.05
PASSED_OVER_S = 0.2
ENOUGH = 3  # samples, for a rate and a gap


def inclinometer(bench: Bench, clock: Clock, seconds: float) -> Check:
    """Listen to the inclinometer for `seconds`."""
    config = bench.inclinometer
    assert config is not None
    try:
        source = SerialSource(config.port, config.baud)
    except Unavailable as error:
        return Check(NAME, "fail", f"not there: {error}", "plug it in; look at [inclinometer] port and baud")
    try:
        samples, rejected, n_bytes = hear_samples(source, wt931.Sampler(sampler_bounds(config), config.baud), clock, seconds)
    except Lost as error:
        return Check(NAME, "fail", str(error), "look at its cable and adapter")
    finally:
        source.close()
    return judge_samples(bench, samples, rejected) if len(samples) >= ENOUGH else _nothing_usable(config, n_bytes)


def _nothing_usable(config: InclinometerConfig, n_bytes: int) -> Check:
    measured = {"bytes": n_bytes}
    if not n_bytes:
        return Check(NAME, "fail", "no bytes", "its power, its cable, its port in the bench file", measured)
    if config.configure:
        do = "each run sets its baud rate first ([inclinometer] configure = true): run, stop, and ask again"
        return Check(NAME, "warn", f"{n_bytes} bytes, no samples at {config.baud} baud", do, measured)
    return Check(
        NAME, "fail", f"{n_bytes} bytes, no samples", f"is its baud rate {config.baud}? `configure = true` sets it", measured
    )


def hear_samples(
    source: SerialSource, sampler: wt931.Sampler, clock: Clock, seconds: float
) -> tuple[list[wt931.Sample], int, int]:
    """(samples, packets thrown away, bytes) of `seconds`; the start, in the middle of something, is passed over. Raises Lost."""
    _feed(source, sampler, clock, PASSED_OVER_S)
    before, before_bytes = sampler.rejected, sampler.parser.taken
    samples = _feed(source, sampler, clock, seconds)
    return samples, sampler.rejected - before, sampler.parser.taken - before_bytes


def _feed(source: SerialSource, sampler: wt931.Sampler, clock: Clock, seconds: float) -> list[wt931.Sample]:
    samples: list[wt931.Sample] = []
    end_ns = clock.now_ns() + round(seconds * 1e9)
    while clock.now_ns() < end_ns:
        data = source.read(WAIT_S)
        samples += sampler.feed(data, clock.now_ns()) if data else []
    return samples


def judge_samples(bench: Bench, samples: list[wt931.Sample], rejected: int) -> Check:
    """Rate and longest gap against the bench file and the gate's age budget; the angle against noise and the gate's limits."""
    config = bench.inclinometer
    assert config is not None
    stamps = [sample.stamp_ns for sample in samples]
    rate_hz = (len(stamps) - 1) * 1e9 / (stamps[-1] - stamps[0])
    gap_ms = max(later - earlier for earlier, later in pairwise(stamps)) * 1e-6
    angles = [mounted_deg(counts_to_deg(s.angle_counts), config.direction, config.zero_deg) for s in samples]
    budget_ms = process_config(bench, "valves").inclination_age_ns * 1e-6 if bench.valves is not None else 30.0
    measured: dict[str, Any] = {
        "rate_hz": rate_hz, "longest_gap_ms": gap_ms, "rejected": rejected, "angle_deg": [min(angles), max(angles)],
    }  # fmt: skip
    found = (
        f"{rate_hz:.0f} Hz of {config.rate_hz}, longest gap {gap_ms:.1f} ms (budget {budget_ms:.1f}), "
        f"thrown away {rejected}, angle {min(angles):.2f} to {max(angles):.2f} deg"
    )
    faults = [
        _rate(config, rate_hz),
        (judged(gap_ms, 2e3 / config.rate_hz, budget_ms), "a USB adapter's latency timer at 1 ms; nothing else on its hub"),
        _angle(bench, config, angles),
        ("warn" if rejected else "pass", "packets are thrown away: cable and ground"),
    ]
    todo = [do for verdict, do in faults if verdict != "pass"]
    return Check(NAME, worst(verdict for verdict, _ in faults), found, "; ".join(todo), measured)


def _rate(config: InclinometerConfig, rate_hz: float) -> tuple[Verdict, str]:
    off = abs(rate_hz - config.rate_hz) > config.rate_tolerance * config.rate_hz
    if off and config.configure:
        return "warn", "each run sets its rate first (configure = true): run, stop, and ask again"
    return "fail" if off else "pass", "rate_hz as the device has it, or configure = true"


def _angle(bench: Bench, config: InclinometerConfig, angles: list[float]) -> tuple[Verdict, str]:
    gate = bench.valves
    if gate is not None and not (gate.angle_min_deg <= min(angles) and max(angles) <= gate.angle_max_deg):
        return "fail", "the gate would not arm: outside angle_min_deg to angle_max_deg; look at direction and zero_deg"
    still = max(angles) - min(angles) <= 2 * config.noise_deg
    return "pass" if still else "warn", "the angle moves: is the rig at rest?"
