"""Physical values to the integers that stand on the wires, and back.

Plain Python without calls among each other, so that each runs here as it is and, compiled, in `quantise_kernels`: the
adapters and the one-process batch get the same bits.
"""

from __future__ import annotations

MA_PER_COUNT = 0.01  # rig.dbc, the current signals
COUNTS_MAX = 65535
VOLTS_PER_COUNT = 10.0 / 32768.0  # rig.dbc, the analogue inputs
INT16_FULL = 32768.0
ANGLE_FULL_DEG = 180.0  # WT931: 32768 counts
RATE_FULL_DEG_S = 2000.0


def current_to_counts(current_ma: float) -> int:
    """Counts of 0.01 mA, rounded half to even as cantools does and held in 0..65535; 0 for what is not a number."""
    if not current_ma > 0.0:
        return 0
    if current_ma >= COUNTS_MAX * MA_PER_COUNT:
        return COUNTS_MAX
    return round(current_ma / MA_PER_COUNT)


def counts_to_current(counts: int) -> float:
    """Counts of 0.01 mA -> mA."""
    return counts * MA_PER_COUNT


def counts_to_kpa(counts: int, zero_v: float, full_v: float, span_kpa: float) -> float:
    """Counts of the analogue module -> gauge pressure, kPa, of a sensor with `span_kpa` between `zero_v` and `full_v`."""
    return (counts * VOLTS_PER_COUNT - zero_v) / (full_v - zero_v) * span_kpa


def kpa_to_counts(pressure_kpa: float, zero_v: float, full_v: float, span_kpa: float) -> int:
    """Gauge pressure, kPa -> counts of the analogue module, saturating; 0 for what is not a number."""
    value = (zero_v + pressure_kpa / span_kpa * (full_v - zero_v)) / VOLTS_PER_COUNT
    if value >= 32767.0:
        return 32767
    if value <= -32768.0:
        return -32768
    if value != value:
        return 0
    return round(value)


def counts_to_deg(counts: int) -> float:
    """WT931 angle counts -> degrees; any number of turns."""
    return counts / INT16_FULL * ANGLE_FULL_DEG


def counts_to_deg_s(counts: int) -> float:
    """WT931 gyro counts -> degrees per second."""
    return counts / INT16_FULL * RATE_FULL_DEG_S


def mounted_deg(angle_deg: float, direction: int, zero_deg: float) -> float:
    """The bending angle from the device's own: `direction` 1 or -1 as it is mounted, `zero_deg` its angle where bending is 0."""
    return direction * angle_deg - zero_deg


def deg_to_counts(angle_deg: float) -> int:
    """A finite angle -> the int16 that a WT931 sends: rounded half to even and wrapped into -180..180 degrees."""
    counts = round(angle_deg / ANGLE_FULL_DEG * INT16_FULL)
    return (counts + 32768) % 65536 - 32768


def value_to_int16(value: float, full_scale: float) -> int:
    """A value -> int16 with 32768 counts at `full_scale`: rounded half to even, saturating; 0 for what is not a number."""
    counts = value / full_scale * INT16_FULL
    if counts >= 32767.0:
        return 32767
    if counts <= -32768.0:
        return -32768
    if counts != counts:
        return 0
    return round(counts)
