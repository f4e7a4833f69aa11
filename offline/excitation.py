"""How well a pressure law brought the chamber along its multi-sine, from a log or from a run in this process."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softloop.offline import metrics
from softloop.offline.closed_loop import Run
from softloop.offline.log import Log, Records
from softloop.wire.errors import BadFile

Floats = NDArray[np.float64]
BAR_KPA = 2.0


@dataclass(frozen=True)
class PressureTracking:
    """Chamber pressure against the desired one, on the trajectory from its first sample on.

    Attributes:
        time_s: (n,) stamps of the pressure samples, since the first one.
        desired_kpa, measured_kpa: (n,), the desired pressure at these stamps.
        truth_max_kpa: largest error of the true pressure, which has the sensor's own errors in it; None without a plant.
    """

    time_s: Floats
    desired_kpa: Floats
    measured_kpa: Floats
    truth_max_kpa: float | None

    @property
    def error_kpa(self) -> Floats:
        return self.measured_kpa - self.desired_kpa

    @property
    def max_kpa(self) -> float:
        return float(np.abs(self.error_kpa).max())

    @property
    def rms_kpa(self) -> float:
        return float(np.sqrt(np.mean(self.error_kpa**2)))

    @property
    def worst_s(self) -> float:
        """When the error was largest."""
        return float(self.time_s[int(np.abs(self.error_kpa).argmax())])

    @property
    def kept(self) -> bool:
        return self.max_kpa <= BAR_KPA


def pressure_tracking(log: Log) -> PressureTracking:
    """The tracking of a logged pressure run. Raises BadFile when the log holds no such trajectory."""
    return _tracking(str(log.path), metrics.tracked(log), _delay_ms(log), log["pressure"], log["truth"])


def run_tracking(run: Run, delay_ms: float) -> PressureTracking:
    """Likewise of a run in this process, from what its controller saw. `delay_ms`: the controller's `actuation_delay_ms`."""
    cycles = run.cycles
    seen = np.zeros(len(cycles), [("stamp_ns", "i8"), ("chamber_pressure_kpa", "f8")])
    seen["stamp_ns"], seen["chamber_pressure_kpa"] = cycles["pressure_stamp_ns"], cycles["chamber_pressure_kpa"]
    return _tracking("run", cycles[cycles["phase"] == metrics.PHASE_TRACK], delay_ms, seen, run.truths)


def _tracking(name: str, track: Records, delay_ms: float, samples: Records, truths: Records) -> PressureTracking:
    """A cycle record's desired pressure stands at the time at which its command acts, the declared delay after its tick."""
    if len(track) < 2 or not np.isfinite(track["desired_pressure_kpa"]).all():
        raise BadFile(f"{name}: no pressure was tracked")
    acts_ns, desired = track["stamp_ns"] + round(1e6 * delay_ms), track["desired_pressure_kpa"]
    measured, truth = _inside(samples, acts_ns), _inside(truths, acts_ns)
    if not len(measured):
        raise BadFile(f"{name}: no pressure was measured on the trajectory")
    truth_error = truth["chamber_pressure_kpa"] - np.interp(truth["stamp_ns"], acts_ns, desired)
    return PressureTracking(
        (measured["stamp_ns"] - measured["stamp_ns"][0]) * 1e-9,
        np.interp(measured["stamp_ns"], acts_ns, desired),
        np.asarray(measured["chamber_pressure_kpa"], np.float64),
        float(np.abs(truth_error).max()) if len(truth) else None,
    )


def _inside(records: Records, stamps_ns: NDArray[np.int64]) -> Records:
    return records[(records["stamp_ns"] >= stamps_ns[0]) & (records["stamp_ns"] <= stamps_ns[-1])]


def _delay_ms(log: Log) -> float:
    try:
        controller = tomllib.loads(log.text("bench.toml")).get("controller", {})
    except tomllib.TOMLDecodeError:
        controller = {}
    return float(controller.get("actuation_delay_ms", 0.0))
