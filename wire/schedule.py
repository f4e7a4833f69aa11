"""A run planned on the rig clock, tick by tick: what lockstep pace and the one-process batch have in common."""

from __future__ import annotations

from dataclasses import dataclass

from softloop.wire.channels import TICK

START_NS = 1_000_000_000  # rig clock of tick 0; not 0, which means "never" in many stamps
PERIOD_NS = round(1e9 / TICK.rate_hz)
LAUNCHER_ORIGIN = 1  # the launcher's number as a requester, where equal runs give equal bytes


@dataclass(frozen=True)
class Schedule:
    """A run from its start to its end: rig clock at which the gate is asked to arm and to disarm, and how many ticks."""

    arm_ns: int
    disarm_ns: int
    ticks: int


def make_schedule(settle_s: float, armed_s: float, vent_s: float) -> Schedule:
    """Settle, then armed for `armed_s`, then `vent_s` to vent."""
    arm_ns = START_NS + round(settle_s * 1e9)
    disarm_ns = arm_ns + round(armed_s * 1e9)
    end_ns = disarm_ns + round(vent_s * 1e9)
    return Schedule(arm_ns, disarm_ns, -(-(end_ns - START_NS) // PERIOD_NS) + 1)
