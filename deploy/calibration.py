"""What measurements at rest and at a known point say of a sensor's zero, gain and sign; pure, and refusing what cannot be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from softloop.devices.config import InclinometerConfig, SensorConfig
from softloop.devices.protocols.quantise import VOLTS_PER_COUNT, counts_to_deg, mounted_deg

LEAST_SAMPLES = 100
ZERO_PART = 0.1  # of full_v - zero_v, by which a zero may differ from the bench file's
GAIN_PART = 0.1  # by which a gain may
LEVER_PART = 0.2  # a known pressure must be at least this part of span_kpa
STILL_PART = 0.02  # of the span, peak to peak: more is no rest
LEAST_BEND_DEG = 20.0
BEND_ERROR_DEG = 10.0  # a protractor at a soft part


@dataclass
class Found:
    """What a look brought.

    Attributes:
        keys: (table, key) -> value for the bench file.
        lines: for a person.
        refused: why nothing of it is to be believed; empty when all is well.
    """

    keys: dict[tuple[str, str], float] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)

    def refuse(self, why: str) -> Found:
        self.refused.append(why)
        return self


def volts_of(counts: Sequence[int]) -> np.ndarray:
    """Counts of the analogue module in volts, shape (n,)."""
    return np.asarray(counts, np.float64) * VOLTS_PER_COUNT


def _rest(found: Found, name: str, sensor: SensorConfig, volts: np.ndarray) -> float | None:
    """The mean of a reading at rest, V; None, with the reason, when it is none."""
    if len(volts) < LEAST_SAMPLES:
        found.refuse(f"{name}: {len(volts)} readings are too few; does the analogue module speak?")
        return None
    spread_v = float(np.ptp(volts))
    if spread_v > STILL_PART * (sensor.full_v - sensor.zero_v):
        kpa = spread_v / (sensor.full_v - sensor.zero_v) * sensor.span_kpa
        found.refuse(f"{name}: moves by {kpa:.1f} kPa; wait until nothing moves")
        return None
    if spread_v == 0.0:
        found.lines.append(f"warning: {name}: does not move at all; a cut wire of a 0 to 10 V sensor reads so")
    return float(volts.mean())


def sensor_zero(name: str, sensor: SensorConfig, volts: np.ndarray) -> Found:
    """`zero_v` from a vented sensor's readings, V; `span_kpa` goes with it, so that the gain stays.

    Args:
        name: of its table below `[pressures]`.
    """
    found = Found()
    mean_v = _rest(found, name, sensor, volts)
    if mean_v is None:
        return found
    span_v, change_v = sensor.full_v - sensor.zero_v, mean_v - sensor.zero_v
    kpa = change_v / span_v * sensor.span_kpa
    if abs(change_v) > ZERO_PART * span_v:
        return found.refuse(
            f"{name}: reads {kpa:.1f} kPa ({mean_v:.3f} V) where 0 should be; is it vented, and zero_v this sensor's?"
        )
    _set(found, name, zero_v=mean_v, span_kpa=sensor.span_kpa * (sensor.full_v - mean_v) / span_v)
    found.lines.append(f"{name}: zero_v {mean_v:.4f}, by {kpa:+.2f} kPa other than before")
    return found


def sensor_gain(name: str, sensor: SensorConfig, volts: np.ndarray, known_kpa: float) -> Found:
    """`span_kpa` from readings at a known gauge pressure, V and kPa; `zero_v` stays as the bench has it."""
    found = Found()
    if not LEVER_PART * sensor.span_kpa <= known_kpa <= sensor.span_kpa:
        low = LEVER_PART * sensor.span_kpa
        return found.refuse(f"{name}: {known_kpa:g} kPa tells little of the gain; {low:g} to {sensor.span_kpa:g} kPa do")
    mean_v = _rest(found, name, sensor, volts)
    if mean_v is None:
        return found
    ratio = (mean_v - sensor.zero_v) / (sensor.full_v - sensor.zero_v) * sensor.span_kpa / known_kpa
    if abs(ratio - 1.0) > GAIN_PART:
        read_kpa = ratio * known_kpa
        return found.refuse(f"{name}: reads {read_kpa:.1f} kPa at {known_kpa:g} kPa; span_kpa, full_v or the manometer is wrong")
    span_kpa = sensor.span_kpa / ratio
    _set(found, name, zero_v=sensor.zero_v, span_kpa=span_kpa)
    found.lines.append(f"{name}: span_kpa {span_kpa:.3f}, the gain by {100 * (ratio - 1):+.2f} % other than before")
    return found


def _set(found: Found, name: str, **keys: float) -> None:
    for key, value in keys.items():
        found.keys[f"pressures.{name}", key] = round(value, 6)


def inclinometer_zero(config: InclinometerConfig, angle_counts: Sequence[int], known_deg: float) -> Found:
    """`zero_deg` from the device's angle where the bending angle is known."""
    found = Found()
    angle_deg = _still_deg(found, config, angle_counts)
    if angle_deg is None:
        return found
    zero_deg = config.direction * angle_deg - known_deg
    if not abs(zero_deg) <= 360.0:  # nan, too, is none
        return found.refuse(f"inclinometer: zero_deg would be {zero_deg:.1f}; re-power the device, it has been turned round")
    found.keys["inclinometer", "zero_deg"] = round(zero_deg, 4)
    found.lines.append(f"inclinometer: zero_deg {zero_deg:.3f}, by {zero_deg - config.zero_deg:+.3f} deg other than before")
    return found


def inclinometer_sign(config: InclinometerConfig, angle_counts: Sequence[int], known_deg: float) -> Found:
    """`direction`, and `zero_deg` with it, from the device's angle at a known bending angle."""
    found = Found()
    if not abs(known_deg) >= LEAST_BEND_DEG:  # nan, too, tells none
        return found.refuse(f"inclinometer: {known_deg:g} deg does not tell the sign; bend it by {LEAST_BEND_DEG:g} deg or more")
    angle_deg = _still_deg(found, config, angle_counts)
    if angle_deg is None:
        return found
    read_deg = mounted_deg(angle_deg, config.direction, config.zero_deg)
    if min(abs(read_deg - known_deg), abs(read_deg + known_deg)) > BEND_ERROR_DEG:
        return found.refuse(
            f"inclinometer: reads {read_deg:.1f} deg at {known_deg:g} deg, and not with the other sign either; "
            "take its zero at rest first, and see that it turns about its X axis"
        )
    right = abs(read_deg - known_deg) <= abs(read_deg + known_deg)
    sign = 1 if right else -1
    found.keys["inclinometer", "direction"] = sign * config.direction
    found.keys["inclinometer", "zero_deg"] = sign * config.zero_deg
    found.lines.append(f"inclinometer: direction {sign * config.direction}, reads {sign * read_deg:.1f} deg at {known_deg:g} deg")
    return found


def _still_deg(found: Found, config: InclinometerConfig, angle_counts: Sequence[int]) -> float | None:
    if len(angle_counts) < LEAST_SAMPLES:
        found.refuse(f"inclinometer: {len(angle_counts)} samples are too few; see `softloop doctor`")
        return None
    angles = np.asarray([counts_to_deg(c) for c in angle_counts])
    if np.ptp(angles) > 2 * config.noise_deg:
        found.refuse(f"inclinometer: moves by {np.ptp(angles):.2f} deg; wait until nothing moves")
        return None
    return float(angles.mean())


def joined(parts: Sequence[Found]) -> Found:
    """All that several looks brought."""
    whole = Found()
    for part in parts:
        whole.keys |= part.keys
        whole.lines += part.lines
        whole.refused += part.refused
    return whole
