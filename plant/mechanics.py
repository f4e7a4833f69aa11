"""The actuator's mechanics: Eq. 2, and beside it memory (hysteresis and creep), payload and contact.

Hysteresis is a sum of stop operators (Prandtl and Ishlinskii): each follows the angle like a spring until it slips at its
width. It does not depend on rate and dissipates on every closed path. Creep is a Prony series of three springs with dashpots.
Both are zero at rest when relaxed, so that the relaxed static map is that of Eq. 2.
"""

from __future__ import annotations

from math import pi, sin
from typing import Any

from numba import types

from softloop.dynamics.bending import bending_acceleration
from softloop.plant.records import MECHANICS_TYPE, MEMORY_TYPE, N_STOPS
from softloop.wire.kernel import kernel

_F8 = types.f8
_RAD = pi / 180.0
GRAVITY_M_S2 = 9.81


@kernel(_F8(MECHANICS_TYPE, MEMORY_TYPE, _F8))
def hysteresis(mechanics: Any, memory: Any, angle_deg: float) -> float:
    """What the stops add at `angle_deg`, deg/s2; exact while the angle has moved one way since the memory was advanced."""
    moved = angle_deg - memory.angle_deg
    total = 0.0
    for i in range(N_STOPS):
        width = mechanics.stop_deg[i]
        total -= mechanics.stop_stiffness[i] * min(max(memory.stop[i] + moved, -width), width)
    return total


@kernel(types.void(MECHANICS_TYPE, MEMORY_TYPE, _F8))
def advance_memory(mechanics: Any, memory: Any, angle_deg: float) -> None:
    """Bring the stops to `angle_deg`."""
    moved = angle_deg - memory.angle_deg
    for i in range(N_STOPS):
        width = mechanics.stop_deg[i]
        memory.stop[i] = min(max(memory.stop[i] + moved, -width), width)
    memory.angle_deg = angle_deg


@kernel(_F8(MECHANICS_TYPE, _F8, _F8, _F8, _F8))
def creep(mechanics: Any, angle_deg: float, first_deg: float, second_deg: float, third_deg: float) -> float:
    """What the three Prony terms add, deg/s2, each stretched from its own slowly following angle."""
    stiffness = mechanics.creep_stiffness
    return -(
        stiffness[0] * (angle_deg - first_deg) + stiffness[1] * (angle_deg - second_deg) + stiffness[2] * (angle_deg - third_deg)
    )


@kernel(_F8(MECHANICS_TYPE, MEMORY_TYPE, _F8, _F8))
def load(mechanics: Any, memory: Any, angle_deg: float, rate_deg_s: float) -> float:
    """What payload (m g sin y) and contact (a wall that only pushes) add, deg/s2.

    The contact's damping grows with its depth (Hunt and Crossley, 1975), so that its force begins at zero.
    """
    total = 0.0
    if memory.payload_deg_s2 != 0.0:
        total -= memory.payload_deg_s2 * sin(_RAD * angle_deg)
    depth = angle_deg - memory.contact_deg
    if memory.contact_1_s2 > 0.0 and depth > 0.0:
        total -= memory.contact_1_s2 * depth * max(0.0, 1.0 + mechanics.contact_s_deg * rate_deg_s)
    return total


@kernel(_F8(MECHANICS_TYPE, MEMORY_TYPE, _F8, _F8, _F8, _F8, _F8, _F8))
def acceleration(
    mechanics: Any,
    memory: Any,
    angle_deg: float,
    rate_deg_s: float,
    pressure_kpa: float,
    first_deg: float,
    second_deg: float,
    third_deg: float,
) -> float:
    """Angular acceleration with everything that acts, deg/s2; the last three are the creep's angles."""
    total = bending_acceleration(mechanics.theta, angle_deg, rate_deg_s, pressure_kpa)
    if mechanics.memory:
        total += hysteresis(mechanics, memory, angle_deg)
        total += creep(mechanics, angle_deg, first_deg, second_deg, third_deg)
    total += load(mechanics, memory, angle_deg, rate_deg_s)
    return total / memory.inertia
