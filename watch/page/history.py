"""The last minutes of a run as rows, one per tick, that any number of viewers read at their own pace."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softloop.wire.messages import constant

# Name in the page -> how it is taken from a cycle record. The first is the time, s since the history began.
COLUMNS = (
    "time_s",
    "angle_deg",
    "reference_deg",
    "error_deg",
    "chamber_pressure_kpa",
    "desired_pressure_kpa",
    "supply_pressure_kpa",
    "charge_current_ma",
    "exhaust_current_ma",
    "mode",
)
_TAKEN = COLUMNS[1:]
_WAIT = constant("CycleRecord", "PHASE_WAIT")
# What the controller has no word on while it waits.
_ASKED = [COLUMNS.index(name) for name in ("reference_deg", "error_deg", "desired_pressure_kpa")]
_HEAD = struct.Struct("<IId")  # rows, columns, time that the rows' times count from


class History:
    """A ring of rows. Rows are numbered from 0; `first` to `head` are there, `head` excluded.

    Attributes:
        head: number of rows that came so far.
        epoch: goes up when the rig clock went back (another run on a clock of its own) and the ring began anew.
    """

    def __init__(self, capacity: int) -> None:
        self._rows = np.zeros((capacity, len(COLUMNS)))
        self._start_ns = 0
        self._last_ns = -(1 << 63)
        self.head = 0
        self.epoch = 0

    @property
    def first(self) -> int:
        return max(0, self.head - len(self._rows))

    @property
    def start_ns(self) -> int:
        """The rig clock at time 0 of the rows."""
        return self._start_ns

    def append(self, cycles: Iterable[Any]) -> None:
        """Take cycle records, oldest first; one that is not newer than the last begins a new history."""
        for cycle in cycles:
            if cycle.stamp_ns <= self._last_ns:
                self.epoch += 1
                self.head = 0
            if self.head == 0:
                self._start_ns = cycle.stamp_ns
            self._last_ns = cycle.stamp_ns
            row = self._rows[self.head % len(self._rows)]
            row[0] = (cycle.stamp_ns - self._start_ns) * 1e-9
            row[1:] = [getattr(cycle, name) for name in _TAKEN]
            if cycle.phase == _WAIT:
                row[_ASKED] = np.nan
            self.head += 1

    def rows(self, first: int, last: int) -> NDArray[np.float64]:
        """Rows `first` to `last` (excluded), (n, columns); what is no longer there is left out."""
        first, last = max(first, self.first), min(last, self.head)
        return self._rows[np.arange(first, max(first, last)) % len(self._rows)]

    def packed(self, first: int, last: int) -> bytes:
        """Rows as the page reads them: number of rows and columns (u32), a time (f64), then f32 row by row.

        The times in the rows count from the one at the head, so that f32 holds them to the microsecond.
        """
        rows = self.rows(first, last)
        base = float(rows[0, 0]) if len(rows) else 0.0
        shifted = rows.copy()
        shifted[:, 0] -= base
        return _HEAD.pack(len(rows), len(COLUMNS), base) + shifted.astype("<f4").tobytes()
