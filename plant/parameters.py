"""The simulated rig's numbers, in two layers.

`ideal` is exactly the controller's own model: Eq. 2 with Table 1, Eq. 11 isothermal at a constant supply, both valves by
Eq. 16 at once. Only the sensors' resolution, noise and sampling remain.

`rig` adds what a real rig has and the model leaves out. The paper prints none of these numbers; they are ours, of the size that
data sheets of such parts show, and stand here once. What differs from rig to rig is drawn by seed (`plant.mismatch`).
"""

from __future__ import annotations

from dataclasses import replace
from math import sqrt
from typing import Any, Literal

from softloop.dynamics.bending import rest_angle
from softloop.dynamics.gas import ATMOSPHERE_PA, GAS_CONSTANT, KAPPA, PA_PER_KPA, mass_flux
from softloop.dynamics.parameters import B0, KV1_CHARGE, KV1_EXHAUST, KV6_CHARGE, KV6_EXHAUST, LEAK, Parameters, model_record
from softloop.plant.mismatch import Draws, draw
from softloop.plant.records import N_IDEAL, N_STATES, PLANT
from softloop.wire.kernel import new_record

Layer = Literal["ideal", "rig"]

# Spool of a miniature proportional valve, Eq. 13: 30 to 100 Hz, well damped by its guide.
SPOOL_HZ = 60.0
SPOOL_DAMPING = 0.7
COIL_LAG_S = 1.5e-3  # of the driver's current stage
# Regulator: 3 % droop at the charge valve's full flow (3.4e-4 kg/s), follows in 30 ms.
SUPPLY_DROOP_KPA_S_KG = 1.8e4
SUPPLY_LAG_S = 0.03
# 1 m of tube, 3.6 mm bore: 10 of the 40 ml. Its resistance, laminar and so by the difference of squared pressures, lets the
# chamber's 30 ml follow in 3 ms at 60 kPa gauge. The tube's own mode is then 1300 1/s there and 2600 1/s at full supply, which
# RK4 holds stable up to steps of 1 ms (2.78 / 2600).
TUBE_VOLUME_SHARE = 0.25
TUBE_LAG_S = 3e-3
TUBE_LAG_AT_KPA = 60.0
# The chamber grows as it bends, counted from the angle at which the parameter file's volume holds.
VOLUME_PER_DEG = 1.5e-3
VOLUME_ANGLE_DEG = 80.0
# Heat between gas and wall: 0.3 s for the gas at 60 kPa gauge, so that what is slower is isothermal and what is faster adiabatic.
WALL_LAG_S = 0.3
# A part of the leak is laminar (a pinhole in silicone, a thread), the rest an orifice; the share is at 60 kPa gauge.
LAMINAR_LEAK_SHARE = 0.3
LAMINAR_LEAK_AT_KPA = 60.0
# Silicone softens by about 0.3 %/K; its rest shape stays.
STIFFNESS_PER_K = -3e-3
STIFFNESS_AT_C = 20.0
# The actuator's memory. Stops slip after 2 to 40 deg; each carries a quarter of HYSTERESIS_DEG_S2. The three creep terms take
# 1, 8 and 60 s. Both sizes are set once so that the paper's own least squares fits this rig as well as it fitted
# the paper's (91 to 94 %); `benchmarks/calibrate_plant.py` prints the fits.
STOP_DEG = (2.0, 6.0, 16.0, 40.0)
HYSTERESIS_DEG_S2 = 200.0
CREEP_S = (1.0, 8.0, 60.0)
CREEP_1_S2 = (2.0, 2.0, 2.0)
# A calibration tank filled with copper wool, which keeps its gas near the wall's temperature (ISO 6358).
TANK_WALL_LAG_S = 0.02
PAYLOAD_ARM_M = 0.1  # tip mass to joint, for its inertia
CONTACT_S_DEG = 0.02
ZERO_C_K = 273.15


def draw_rig(layer: Layer, seed: int, parameters: Parameters, ambient_c: float | None = None) -> Any:
    """A `PLANT` record of `layer` with its physics filled in; sensors and wires are `plant.setup`'s.

    Args:
        layer: "ideal" takes nothing from the seed but the phases of its clocks.
        seed: which rig, 0 or more.
        parameters: the parameter file about which the rig is drawn.
        ambient_c: temperature in place of the drawn one; the ideal layer stays at the model's.
    """
    drawn = draw(seed)
    if ambient_c is not None:
        drawn = replace(drawn, ambient_c=ambient_c)
    plant = new_record(PLANT)
    plant.seed, plant.rig = seed, layer == "rig"
    plant.n_states = N_STATES if plant.rig else N_IDEAL
    if not plant.rig:
        drawn = Draws(phases=drawn.phases)
    _fill_mechanics(plant.mechanics, model_record(parameters), drawn, rig=bool(plant.rig))
    _fill_air(plant.air, model_record(parameters), drawn)
    if plant.rig:
        _add_rig_air(plant.air, drawn, parameters.pneumatics.current_max_ma)
    return plant


def _fill_mechanics(mechanics: Any, model: Any, drawn: Draws, *, rig: bool) -> None:
    mechanics.theta[:] = model.theta
    for i, fraction in enumerate(drawn.theta_fraction):
        mechanics.theta[i] = model.theta_min[i] + fraction * (model.theta_max[i] - model.theta_min[i])
    for i in (0, 1, 2, 7):  # a0, a1, a2 and d
        mechanics.theta[i] *= 1.0 + STIFFNESS_PER_K * (drawn.ambient_c - STIFFNESS_AT_C)
    mechanics.rest_deg = rest_angle(mechanics.theta)
    mechanics.payload_arm_m, mechanics.contact_s_deg = PAYLOAD_ARM_M, CONTACT_S_DEG
    mechanics.memory = rig
    if rig:
        mechanics.stop_deg[:] = STOP_DEG
        mechanics.stop_stiffness[:] = [HYSTERESIS_DEG_S2 / len(STOP_DEG) / width for width in STOP_DEG]
        mechanics.creep_stiffness[:] = CREEP_1_S2
        mechanics.creep_rate[:] = [1.0 / lag for lag in CREEP_S]


def _fill_air(air: Any, model: Any, drawn: Draws) -> None:
    """All that both layers have; in the ideal layer at the model's own numbers."""
    air.charge, air.exhaust = model.charge, model.exhaust
    air.k_v1_charge, air.k_v1_exhaust = model.theta[KV1_CHARGE] * drawn.k_v1[0], model.theta[KV1_EXHAUST] * drawn.k_v1[1]
    air.k_v6_charge, air.k_v6_exhaust = model.theta[KV6_CHARGE] * drawn.k_v6[0], model.theta[KV6_EXHAUST] * drawn.k_v6[1]
    air.leak_m2 = model.theta[LEAK] * drawn.leak
    air.wall_k = model.temperature_k
    air.flow_scale = model.discharge / sqrt(air.wall_k)
    air.exponent = 1.0
    air.volume_m3 = model.volume_m3 * drawn.volume
    air.supply_kpa = model.supply_kpa * drawn.supply


def _add_rig_air(air: Any, drawn: Draws, current_max_ma: float) -> None:
    ambient_k = drawn.ambient_c + ZERO_C_K
    air.flow_scale *= sqrt(air.wall_k / ambient_k)
    air.wall_k = ambient_k
    discharge = air.flow_scale * sqrt(ambient_k)
    at_pa = PA_PER_KPA * LAMINAR_LEAK_AT_KPA
    orifice = air.leak_m2 * mass_flux(at_pa + ATMOSPHERE_PA, ATMOSPHERE_PA, ambient_k, discharge)
    air.leak_laminar_kg_s_pa = LAMINAR_LEAK_SHARE * orifice / at_pa
    air.leak_m2 *= 1.0 - LAMINAR_LEAK_SHARE
    air.tube_volume_m3 = TUBE_VOLUME_SHARE * air.volume_m3
    air.volume_m3 -= air.tube_volume_m3
    air.volume_per_deg, air.volume_angle_deg = VOLUME_PER_DEG, VOLUME_ANGLE_DEG
    mean_pa = PA_PER_KPA * TUBE_LAG_AT_KPA + ATMOSPHERE_PA
    air.tube_kg_s_pa2 = air.volume_m3 / (GAS_CONSTANT * ambient_k * TUBE_LAG_S) / (2.0 * mean_pa)
    air.exponent = KAPPA
    gas_kg = mean_pa * air.volume_m3 / (GAS_CONSTANT * ambient_k)
    air.wall_w_k = gas_kg * GAS_CONSTANT / (KAPPA - 1.0) / WALL_LAG_S
    air.supply_droop_kpa_s_kg, air.supply_rate = SUPPLY_DROOP_KPA_S_KG, 1.0 / SUPPLY_LAG_S
    air.spool_rad_s, air.spool_damping = 2.0 * 3.141592653589793 * SPOOL_HZ, SPOOL_DAMPING
    air.coil_lag_s = COIL_LAG_S
    air.play_charge_ma = 0.5 * drawn.play_fraction[0] * current_max_ma
    air.play_exhaust_ma = 0.5 * drawn.play_fraction[1] * current_max_ma


def fit_tank(plant: Any, tank_m3: float) -> None:
    """Put a tight, rigid, isothermal tank of `tank_m3`, tubing included, on the port; the actuator is off and rests."""
    air = plant.air
    air.volume_m3 = tank_m3 - air.tube_volume_m3
    air.volume_per_deg = air.leak_m2 = air.leak_laminar_kg_s_pa = 0.0
    gas_kg = (PA_PER_KPA * TUBE_LAG_AT_KPA + ATMOSPHERE_PA) * air.volume_m3 / (GAS_CONSTANT * air.wall_k)
    air.wall_w_k = gas_kg * GAS_CONSTANT / (KAPPA - 1.0) / TANK_WALL_LAG_S
    plant.mechanics.theta[B0] = 0.0
