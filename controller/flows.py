"""What the commands under way do to the chamber: pressure over a time from their flows, and the mechanics under it.

Times are in seconds, relative to the instant at which the newest command begins to act. Command j before it has acted since
-j periods, until the next one did; the newest acts on. So a time may lie before or after, and a span may cover any delay that
the flows reach back to.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from softloop.controller.records import N_FLOWS, OBSERVER_TYPE
from softloop.dynamics.bending import bending_acceleration
from softloop.dynamics.parameters import THETA_TYPE
from softloop.wire.kernel import kernel

_F8 = types.f8
_STEP_S = 2e-3  # midpoint steps: at the mechanics' 10 rad/s their error is far below a sensor's
_LONGEST_S = 0.3  # no state is carried further than this


@kernel(_F8(OBSERVER_TYPE, _F8, _F8, _F8))
def supplied_forward(observer: Any, period_s: float, start_s: float, end_s: float) -> float:
    """`supplied` where `end_s` is not before `start_s`."""
    total, until = 0.0, end_s
    for j in range(N_FLOWS):
        since = -j * period_s if j < N_FLOWS - 1 else start_s
        since = max(since, start_s)
        if since < until:
            total += observer.flow_kpa_s[j] * (until - since)
            until = since
        if until <= start_s:
            break
    return total


@kernel(_F8(OBSERVER_TYPE, _F8, _F8, _F8))
def supplied(observer: Any, period_s: float, start_s: float, end_s: float) -> float:
    """The integral of the flows from `start_s` to `end_s`, kPa; the oldest known flow stands for all before it."""
    if end_s < start_s:
        return -supplied_forward(observer, period_s, end_s, start_s)
    return supplied_forward(observer, period_s, start_s, end_s)


@kernel(types.UniTuple(_F8, 3)(OBSERVER_TYPE, THETA_TYPE, _F8, _F8, _F8, _F8, _F8, _F8))
def carried(
    observer: Any, theta: np.ndarray, period_s: float, angle_deg: float, rate_deg_s: float, chamber_kpa: float, start_s: float,
    end_s: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Angle, rate and chamber pressure at `end_s`, from those at `start_s`, by Eq. 2 with the observer's disturbance."""
    span = min(max(end_s - start_s, 0.0), _LONGEST_S)
    steps = int(span / _STEP_S) + 1
    step = span / steps
    for k in range(steps):
        now = start_s + k * step
        middle_kpa = max(chamber_kpa + supplied(observer, period_s, now, now + 0.5 * step), 0.0)
        push = observer.disturbance_deg_s2
        slope = bending_acceleration(theta, angle_deg, rate_deg_s, chamber_kpa) + push
        middle_angle, middle_rate = angle_deg + 0.5 * step * rate_deg_s, rate_deg_s + 0.5 * step * slope
        slope = bending_acceleration(theta, middle_angle, middle_rate, middle_kpa) + push
        angle_deg += step * middle_rate
        rate_deg_s += step * slope
        chamber_kpa = max(chamber_kpa + supplied(observer, period_s, now, now + step), 0.0)
    return angle_deg, rate_deg_s, chamber_kpa


@kernel(types.void(OBSERVER_TYPE))
def shift_flows(observer: Any) -> None:
    """One tick further: every flow is a tick older, the newest stands on."""
    for j in range(N_FLOWS - 1, 0, -1):
        observer.flow_kpa_s[j] = observer.flow_kpa_s[j - 1]


@kernel(types.void(OBSERVER_TYPE, _F8, types.i8))
def remember_flow(observer: Any, flow_kpa_s: float, ticks: int) -> None:
    """Put a new command's flow first; what went before stood for `ticks` ticks."""
    for _ in range(min(max(ticks - 1, 0), N_FLOWS)):
        shift_flows(observer)
    shift_flows(observer)
    observer.flow_kpa_s[0] = flow_kpa_s
