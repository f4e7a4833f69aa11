"""What must hold while a rig is driven, judged on one cycle record after the other: pure functions, no wires, no clock.

| invariant | it does not hold when | seen after |
|---|---|---|
| parameters | an estimate is outside its set, or no number | 1 tick |
| command | a current is outside 0 to saturation, or no number | 1 tick |
| error | its size on the trajectory is above the envelope on `error_ticks` ticks in a row | `error_ticks` |
| chatter | the working mode changed more than `switches_max` times within one second | at most 1 s |
| bound | V2 is above Eq. 50's ultimate bound though its assumptions have held for `settled_ticks` | 1 tick |

With V2 = (S1^2 + rho S2^2) / 2, Eq. 50 is V2 <= exp(-2 lambda t) V2(0) + epsilon / (2 lambda), lambda = min(k1, k2) and
epsilon = epsilon1 + rho epsilon2. Its assumptions: no saturation (of currents or of the desired pressure), no hold mode,
parameters inside their set. A bound that is passed all the same says that a disturbance is larger than delta1 or delta2, or a
true parameter outside its set.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, inf, isfinite
from typing import Any, NamedTuple

from softloop.wire.messages import constant

PARAMETERS, COMMAND, ERROR, CHATTER, BOUND = (
    constant("Event", f"INVARIANT_{n}") for n in ("PARAMETERS", "COMMAND", "ERROR", "CHATTER", "BOUND")
)
_HOLD = constant("ValveCommand", "MODE_HOLD")
_WAIT, _TRACK, _DONE = (constant("CycleRecord", f"PHASE_{n}") for n in ("WAIT", "TRACK", "DONE"))
PERIOD_S = 0.005
SECOND_TICKS = 200
_ROUNDING = 1e-9  # of a parameter's bound, relative


@dataclass(frozen=True)
class Limits:
    """Where the invariants end. One that is not watched has no limit (inf); the sets also serve the bound.

    Attributes:
        theta: (lowest, highest) of each estimate. watch_theta: an estimate outside is a verdict of its own.
        current_max_ma: saturation of both currents.
        error_max_deg, error_ticks: the envelope, and for how many ticks in a row it must be left.
        switches_max: changes of the working mode within one second.
        v2_max: Eq. 50's ultimate bound, margin included, (deg/s)^2. rho: weight of S2.
        settled_ticks: for how long the assumptions must have held before the bound is asked for.
        desired_max_kpa: the law's own limit of the desired pressure.
    """

    theta: tuple[tuple[float, float], ...] = ()
    watch_theta: bool = True
    current_max_ma: float = inf
    error_max_deg: float = inf
    error_ticks: int = 1
    switches_max: float = inf
    v2_max: float = inf
    rho: float = 1.0
    settled_ticks: int = 1
    desired_max_kpa: float = inf


class Memory(NamedTuple):
    """What is kept from record to record."""

    mode: int = _HOLD
    switches: tuple[int, ...] = ()  # ticks of the last second on which the mode changed
    error_ticks: int = 0
    settled_ticks: int = 0
    tick: int = -1


class Verdict(NamedTuple):
    """An invariant that does not hold, and the number that says so."""

    invariant: int
    value: float


def ultimate_v2(k1: float, k2: float, epsilon: float) -> tuple[float, float]:
    """Eq. 50: what V2 may be in the end, and its rate of decay 2 lambda, 1/s."""
    decay = 2.0 * min(k1, k2)
    return epsilon / decay, decay


def settling_ticks(decay_1_s: float, part: float = 0.01) -> int:
    """Ticks until a start has decayed to `part` of itself."""
    ticks = 1
    while exp(-decay_1_s * PERIOD_S * ticks) > part:
        ticks += 1
    return ticks


def detection_ticks(limits: Limits) -> dict[int, int]:
    """Invariant -> ticks, from the first on which it does not hold until it is seen, at most."""
    return {PARAMETERS: 1, COMMAND: 1, ERROR: limits.error_ticks, CHATTER: SECOND_TICKS, BOUND: 1}


def judge(limits: Limits, memory: Memory, cycle: Any) -> tuple[Memory, tuple[Verdict, ...]]:
    """The next record of a run: what to keep, and which invariants do not hold.

    Args:
        cycle: anything with the fields of `CycleRecord`. Where the rig is not driven (waiting, done) nothing is judged.
    """
    if cycle.phase in (_WAIT, _DONE):
        return Memory(), ()
    inside = _parameter_outside(limits, cycle) is None
    after = Memory(
        int(cycle.mode),
        _switches(memory, cycle),
        memory.error_ticks + 1 if _error_outside(limits, cycle) else 0,
        memory.settled_ticks + 1 if inside and _assumed(limits, cycle) else 0,
        int(cycle.tick),
    )
    found = (*_of_this_record(limits, cycle), *_of_the_past(limits, after, cycle))
    return after, found


def _of_this_record(limits: Limits, cycle: Any) -> list[Verdict]:
    found = []
    outside = _parameter_outside(limits, cycle)
    if limits.watch_theta and outside is not None:
        found.append(Verdict(PARAMETERS, float(outside)))
    for current in (cycle.charge_current_ma, cycle.exhaust_current_ma):
        if isfinite(limits.current_max_ma) and not 0.0 <= current <= limits.current_max_ma:
            found.append(Verdict(COMMAND, float(current)))
    return found


def _of_the_past(limits: Limits, memory: Memory, cycle: Any) -> list[Verdict]:
    found = []
    if memory.error_ticks >= limits.error_ticks:
        found.append(Verdict(ERROR, float(cycle.error_deg)))
    if len(memory.switches) > limits.switches_max:
        found.append(Verdict(CHATTER, float(len(memory.switches))))
    if memory.settled_ticks >= limits.settled_ticks and v2_of(limits, cycle) > limits.v2_max:
        found.append(Verdict(BOUND, v2_of(limits, cycle) / limits.v2_max))
    return found


def v2_of(limits: Limits, cycle: Any) -> float:
    """V2 = (S1^2 + rho S2^2) / 2, (deg/s)^2."""
    return 0.5 * float(cycle.s1_deg_s**2 + limits.rho * cycle.s2_kpa**2)


def _parameter_outside(limits: Limits, cycle: Any) -> int | None:
    """The first place of theta that is outside its set."""
    for place, (value, (low, high)) in enumerate(zip(cycle.theta, limits.theta, strict=False)):
        slack = _ROUNDING * max(abs(low), abs(high))
        if not low - slack <= value <= high + slack:
            return place
    return None


def _error_outside(limits: Limits, cycle: Any) -> bool:
    watched = isfinite(limits.error_max_deg) and cycle.phase == _TRACK
    return watched and not abs(cycle.error_deg) <= limits.error_max_deg


def _switches(memory: Memory, cycle: Any) -> tuple[int, ...]:
    """The ticks of the last second on which the mode changed. The first record after a rest changes nothing."""
    kept = tuple(tick for tick in memory.switches if cycle.tick - tick < SECOND_TICKS)
    return (*kept, int(cycle.tick)) if memory.tick >= 0 and cycle.mode != memory.mode else kept


def _assumed(limits: Limits, cycle: Any) -> bool:
    """Whether Eq. 50 speaks of this tick."""
    free = 0.0 < cycle.desired_pressure_kpa < limits.desired_max_kpa
    return bool(free and not cycle.saturated and cycle.mode != _HOLD and cycle.inputs_valid)
