"""Flow of air through an orifice, Eqs. 12, 20 and 21, with both misprinted constants corrected.

The printed C1 and C2 leave a jump of a factor four at the critical ratio. Derived anew from isentropic nozzle flow they meet
there to the last digit, with equal slope: C2 psi(r_c) = C1 and psi'(r_c) = 0.
"""

from __future__ import annotations

from math import sqrt

from numba import types

from softloop.wire.kernel import kernel

GAS_CONSTANT = 287.0  # R, N m / (kg K), of the paper
KAPPA = 1.4
PA_PER_KPA = 1000.0  # S_p of Eq. 11
ATMOSPHERE_PA = 101_325.0  # "standard atmosphere", Eq. 19

CRITICAL_RATIO = (2.0 / (KAPPA + 1.0)) ** (KAPPA / (KAPPA - 1.0))  # 0.528...
C1 = sqrt(KAPPA / GAS_CONSTANT * (2.0 / (KAPPA + 1.0)) ** ((KAPPA + 1.0) / (KAPPA - 1.0)))
C2 = sqrt(2.0 * KAPPA / (GAS_CONSTANT * (KAPPA - 1.0)))

# Above this pressure ratio the flow is taken as linear in (1 - r): there the square root's slope goes to infinity while
# real orifices turn laminar. At 40 ml it bounds the fastest pressure mode at about 160 1/s.
LAMINAR_RATIO = 0.999
_EXPONENT = (KAPPA - 1.0) / KAPPA  # 2/7; r^(1/kappa) = r / r^(2/7) saves a second power


@kernel(types.f8(types.f8))
def flow_function(ratio: float) -> float:
    """psi(r), Eq. 12 less C_f A P_u / sqrt(T): C1 when choked, falling to 0 at r = 1. `ratio` = P_d / P_u in [0, 1]."""
    if ratio <= CRITICAL_RATIO:
        return C1
    if ratio > LAMINAR_RATIO:
        power = LAMINAR_RATIO**_EXPONENT
        return C2 * (LAMINAR_RATIO / power) * sqrt(1.0 - power) * (1.0 - ratio) / (1.0 - LAMINAR_RATIO)
    power = ratio**_EXPONENT
    return C2 * (ratio / power) * sqrt(1.0 - power)


@kernel(types.f8(types.f8, types.f8, types.f8, types.f8))
def mass_flux(first_pa: float, second_pa: float, temperature_k: float, discharge: float) -> float:
    """g2 of Eq. 21, kg/(s m2), from absolute pressures; negative when it flows from the second to the first."""
    if first_pa >= second_pa:
        return discharge * first_pa / sqrt(temperature_k) * flow_function(second_pa / first_pa)
    return -discharge * second_pa / sqrt(temperature_k) * flow_function(first_pa / second_pa)


@kernel(types.f8(types.f8, types.f8))
def pressure_rate_per_flow(temperature_k: float, volume_m3: float) -> float:
    """g1 of Eq. 20: (kPa/s) per (kg/s), isothermal."""
    return GAS_CONSTANT * temperature_k / (PA_PER_KPA * volume_m3)
