"""The unbalanced proportional valve, Eqs. 14 to 16, 22 and 23: orifice area from current, and back.

Pressures are gauge, in Pa, as the coefficients were fitted. The text's Eq. 16 has no limits; a spool has two, so the area is
held in [0, area_max]: below the opening current the valve is shut (the dead zone), above full stroke it opens no further.
"""

from __future__ import annotations

from typing import Any

from numba import types

from softloop.dynamics.parameters import VALVE_SHAPE_TYPE
from softloop.wire.kernel import kernel

_F8 = types.f8
_MIN_DENOMINATOR = 1e-3  # Eq. 16 has no meaning at 1 - k_v2 P_u + k_v4 P_d <= 0; parameter files are refused there


@kernel(_F8(VALVE_SHAPE_TYPE, _F8, _F8))
def g3(shape: Any, upstream_pa: float, downstream_pa: float) -> float:
    """Eq. 22; gauge pressures, no unit."""
    return 1.0 / max(_MIN_DENOMINATOR, 1.0 - shape.k_v2_pa * upstream_pa + shape.k_v4_pa * downstream_pa)


@kernel(_F8(VALVE_SHAPE_TYPE, _F8, _F8))
def g4(shape: Any, upstream_pa: float, downstream_pa: float) -> float:
    """Eq. 23; gauge pressures, m2."""
    force = -shape.k_v3_m2_pa * upstream_pa + shape.k_v5_m2_pa * downstream_pa
    return force * g3(shape, upstream_pa, downstream_pa)


@kernel(_F8(VALVE_SHAPE_TYPE, _F8, _F8, _F8, _F8, _F8))
def orifice_area(
    shape: Any, k_v1_m2_ma: float, k_v6_m2: float, current_ma: float, upstream_pa: float, downstream_pa: float
) -> float:
    """Eq. 16 with the spool's two stops, m2."""
    open_area = g3(shape, upstream_pa, downstream_pa) * (k_v1_m2_ma * current_ma - k_v6_m2) + g4(
        shape, upstream_pa, downstream_pa
    )
    return min(max(open_area, 0.0), shape.area_max_m2)


@kernel(_F8(VALVE_SHAPE_TYPE, _F8, _F8, _F8, _F8, _F8))
def current_for_area(
    shape: Any, k_v1_m2_ma: float, k_v6_m2: float, area_m2: float, upstream_pa: float, downstream_pa: float
) -> float:
    """The current at which Eq. 16 gives this area (its inverse), mA; not limited."""
    area = min(area_m2, shape.area_max_m2)
    scale = g3(shape, upstream_pa, downstream_pa)
    return ((area - g4(shape, upstream_pa, downstream_pa)) / scale + k_v6_m2) / k_v1_m2_ma
