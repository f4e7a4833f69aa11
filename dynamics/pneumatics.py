"""The pressure dynamics the controller knows, Eqs. 11, 17 to 19 and 25 to 28.

P_v' = f1 (theta_10 I_i - theta_11) + f2 - f3 theta_12 + Delta_2, kPa/s, with i = 1 charging and i = 2 exhausting. f1 and f2
carry the exhaust's minus sign. The two valves differ, so theta_10 and theta_11 stand once per valve (see `parameters`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from softloop.dynamics.gas import ATMOSPHERE_PA, PA_PER_KPA, mass_flux, pressure_rate_per_flow
from softloop.dynamics.parameters import KV1_CHARGE, KV1_EXHAUST, KV6_CHARGE, KV6_EXHAUST, LEAK, MODEL_TYPE, THETA_TYPE
from softloop.dynamics.valve import g3, g4, orifice_area
from softloop.wire.kernel import kernel

_F8 = types.f8
_TRIPLE = types.UniTuple(_F8, 3)


@kernel(_TRIPLE(MODEL_TYPE, types.b1, _F8, _F8))
def known_terms(model: Any, charging: bool, supply_kpa: float, chamber_kpa: float) -> tuple[float, float, float]:
    """f1, f2 and f3 of Eqs. 26 to 28: (kPa/s)/m2, kPa/s and (kPa/s)/m2."""
    supply_pa, chamber_pa = PA_PER_KPA * supply_kpa, PA_PER_KPA * chamber_kpa
    g1 = pressure_rate_per_flow(model.temperature_k, model.volume_m3)
    out = g1 * mass_flux(chamber_pa + ATMOSPHERE_PA, ATMOSPHERE_PA, model.temperature_k, model.discharge)
    if charging:
        flux = g1 * mass_flux(supply_pa + ATMOSPHERE_PA, chamber_pa + ATMOSPHERE_PA, model.temperature_k, model.discharge)
        return flux * g3(model.charge, supply_pa, chamber_pa), flux * g4(model.charge, supply_pa, chamber_pa), out
    return -out * g3(model.exhaust, chamber_pa, 0.0), -out * g4(model.exhaust, chamber_pa, 0.0), out


@kernel(_F8(MODEL_TYPE, THETA_TYPE, _F8, _F8, _F8, _F8))
def pressure_rate(
    model: Any, theta: np.ndarray, supply_kpa: float, chamber_kpa: float, charge_ma: float, exhaust_ma: float
) -> float:
    """Eq. 11 with Eqs. 17 to 19 and both valves' stops, kPa/s: what the currents do to the chamber, by the model."""
    supply_pa, chamber_pa = PA_PER_KPA * supply_kpa, PA_PER_KPA * chamber_kpa
    area_in = orifice_area(model.charge, theta[KV1_CHARGE], theta[KV6_CHARGE], charge_ma, supply_pa, chamber_pa)
    area_out = orifice_area(model.exhaust, theta[KV1_EXHAUST], theta[KV6_EXHAUST], exhaust_ma, chamber_pa, 0.0)
    g1 = pressure_rate_per_flow(model.temperature_k, model.volume_m3)
    out = mass_flux(chamber_pa + ATMOSPHERE_PA, ATMOSPHERE_PA, model.temperature_k, model.discharge)
    into = 0.0
    if area_in > 0.0:
        into = mass_flux(supply_pa + ATMOSPHERE_PA, chamber_pa + ATMOSPHERE_PA, model.temperature_k, model.discharge)
    return g1 * (into * area_in - out * (area_out + theta[LEAK]))
