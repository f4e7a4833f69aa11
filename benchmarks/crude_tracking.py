"""Realistic valve currents: a crude controller follows a ten-tone reference on the simulated rig in a jittered 5 ms loop."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Any

import numpy as np

from softloop.dynamics.bending import pressure_for
from softloop.dynamics.noise import gaussian, uniform
from softloop.dynamics.parameters import (
    KV1_CHARGE,
    KV1_EXHAUST,
    KV6_CHARGE,
    KV6_EXHAUST,
    load_parameters,
    model_record,
    shipped,
)
from softloop.dynamics.pneumatics import known_terms
from softloop.dynamics.valve import current_for_area
from softloop.plant.config import PlantConfig
from softloop.plant.physics import advance, block_kpa, settle_inputs
from softloop.plant.records import ANGLE, RATE, SUPPLY
from softloop.plant.setup import new_device, new_state, plant_record

TICK_NS = 5_000_000
FRAME_NS = 270_000
LOW_DEG, HIGH_DEG = 45.0, 115.0
TONES_HZ = np.linspace(0.05, 0.5, 10)
START_S = 3.0  # the reference rises smoothly from the rest angle within this time


@dataclass(frozen=True)
class Currents:
    """Currents and the instants at which their frames end on the wire; shapes (n,)."""

    end_ns: np.ndarray
    charge_ma: np.ndarray
    exhaust_ma: np.ndarray


def reference(seconds: float) -> tuple[float, float, float]:
    """Angle, rate and acceleration of the ten tones, deg."""
    phase = 2.0 * pi * TONES_HZ * seconds + np.arange(10.0) ** 2
    size, w = 0.5 * (HIGH_DEG - LOW_DEG) / 4.2, 2.0 * pi * TONES_HZ  # these phases peak at 4.2 tones
    wave, rate, acceleration = size * np.sin(phase), size * w * np.cos(phase), -size * w**2 * np.sin(phase)
    return 0.5 * (LOW_DEG + HIGH_DEG) + float(wave.sum()), float(rate.sum()), float(acceleration.sum())


def currents_for(model: Any, angle: float, rate: float, supply: float, pressure: float, seconds: float) -> tuple[float, float]:
    """One tick of the crude controller: feed-forward pressure, a proportional part, and the valves' inverse."""
    wanted, wanted_rate, wanted_acceleration = reference(seconds)
    ease = min(1.0, seconds / START_S)
    acceleration = wanted_acceleration + 8.0 * (wanted_rate - rate) + 40.0 * ease * (wanted - angle)
    desired = ease * pressure_for(model.theta, wanted, wanted_rate, acceleration)
    flow = 30.0 * (min(max(desired, 0.0), 150.0) - pressure)
    if abs(flow) < 4.0:
        return 0.0, 0.0
    charging = flow > 0.0
    at_one_m2, _, _ = known_terms(model, charging, supply, pressure)
    area = min(flow / at_one_m2, 6e-7) if at_one_m2 != 0.0 else 0.0
    theta = model.theta
    if charging:
        current = current_for_area(model.charge, theta[KV1_CHARGE], theta[KV6_CHARGE], area, 1e3 * supply, 1e3 * pressure)
        return min(max(current, 0.0), 220.0), 0.0
    current = current_for_area(model.exhaust, theta[KV1_EXHAUST], theta[KV6_EXHAUST], area, 1e3 * pressure, 0.0)
    return 0.0, min(max(current, 0.0), 220.0)


def track(layer: str, seconds: float, seed: int = 1) -> Currents:
    """Let the crude controller run on a rig; what it sent."""
    model = model_record(load_parameters(shipped()))
    config = PlantConfig.model_validate({"layer": layer, "seed": seed})
    params = plant_record(config)
    state = new_state(params, new_device(config), 0)
    sent: list[tuple[int, float, float]] = []
    for tick in range(round(seconds * 1e9) // TICK_NS):
        advance(params, state, tick * TICK_NS)
        angle = state.x[ANGLE] + 0.05 * gaussian(seed, 90, tick)
        pressure = block_kpa(params, state) + 0.1 * gaussian(seed, 91, tick)
        charge, exhaust = currents_for(model, angle, state.x[RATE], state.x[SUPPLY], pressure, tick * TICK_NS * 1e-9)
        end_ns = tick * TICK_NS + FRAME_NS + round(1.5e6 * uniform(seed, 92, tick))
        sent.append((end_ns, round(charge, 2), round(exhaust, 2)))
        advance(params, state, end_ns)
        apply(params, state, charge, exhaust)
    ends, charges, exhausts = (np.array(column) for column in zip(*sent, strict=True))
    return Currents(ends.astype(np.int64), charges, exhausts)


def apply(params: Any, state: Any, charge_ma: float, exhaust_ma: float) -> None:
    """Give the driver its currents at the state's time."""
    state.command_charge_ma, state.command_exhaust_ma = charge_ma, exhaust_ma
    settle_inputs(params, state)
