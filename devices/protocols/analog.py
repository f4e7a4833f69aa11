"""From the analogue module's frames to pressure samples: counting, stamp, range.

Plain Python without numba, so that it runs in the adapter as it is and, compiled (`analog_kernels`), in the one-process batch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

COUNTER_STATES = 256
NOTHING, SAMPLE = 0, 1


@dataclass
class AnalogConfig:
    """What `analog_step` is told: a frame's time on the wire, and the range of believable readings of each sensor."""

    frame_ns: int
    supply_low_kpa: float
    supply_high_kpa: float
    chamber_low_kpa: float
    chamber_high_kpa: float


@dataclass
class AnalogState:
    """What `analog_step` knows; the last sample's stamp and range among it."""

    counter: int = -1  # of the last frame; -1 before the first
    seq: int = 0
    missed: int = 0
    stamp_ns: int = 0
    in_range: int = 0


_I8, _F8 = np.int64, np.float64
ANALOG_CONFIG = np.dtype(
    (
        np.record,
        np.dtype(
            [("frame_ns", _I8)] + [(f"{sensor}_{end}_kpa", _F8) for sensor in ("supply", "chamber") for end in ("low", "high")],
            align=True,
        ),
    )
)
ANALOG_STATE = np.dtype(
    (np.record, np.dtype([(n, _I8) for n in ("counter", "seq", "missed", "stamp_ns", "in_range")], align=True))
)


def analog_step(
    config: Any, state: Any, counter: int, supply_kpa: float, chamber_kpa: float, frame_stamp_ns: int, received_ns: int
) -> int:
    """One frame -> SAMPLE, or NOTHING when it is the one before again. Takes the two records or the two dataclasses.

    The module sampled at the latest the frame's time on the wire ago; earlier where the frame's own stamp says that it has
    waited for its reader.
    """
    if counter == state.counter:
        return NOTHING
    if state.counter >= 0:
        state.missed += (counter - state.counter - 1) % COUNTER_STATES
    state.counter = counter
    state.seq += 1
    state.stamp_ns = min(frame_stamp_ns, received_ns - config.frame_ns)
    supply_fits = config.supply_low_kpa <= supply_kpa <= config.supply_high_kpa
    chamber_fits = config.chamber_low_kpa <= chamber_kpa <= config.chamber_high_kpa
    state.in_range = 1 if supply_fits and chamber_fits else 0
    return SAMPLE
