"""Whether the paper's own identification fits the simulated rig as well as it fitted the paper's.

The pressure is imposed on the rig layer's mechanics alone, as a multi-sine over 5 to 110 kPa. Eq. 2 is fitted to 80 s of it in
[0, 1] Hz by filtered least squares (Eqs. 6 to 10, m = 2, n = 0, r = 3), and then simulated freely, from the pressure alone, over
80 s that it has not seen in [0, 1] Hz and in [0, 0.5] Hz. The paper reports 92.9 and 90.8 % (NRMSE fit).

    python benchmarks/calibrate_plant.py
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from scipy.signal import bilinear, lfilter

from softloop.dynamics.bending import bending_acceleration
from softloop.dynamics.noise import gaussian, uniform
from softloop.dynamics.parameters import N_THETA, THETA_TYPE, load_parameters, shipped
from softloop.plant.mechanics import acceleration, advance_memory
from softloop.plant.parameters import CREEP_1_S2, HYSTERESIS_DEG_S2, draw_rig
from softloop.plant.records import MECHANICS_TYPE, MEMORY, MEMORY_TYPE, N_CREEP
from softloop.wire.kernel import array_of, kernel, new_record

SAMPLE_S = 0.005
SUBSTEPS = 5
SECONDS, SETTLE_S = 80.0, 30.0
LOW_KPA, HIGH_KPA = 5.0, 110.0
NOISE_DEG = 0.05
SINES = 20
CUTOFFS_RAD_S = (10.0, 20.0, 40.0)  # the paper does not say which it used
SEEDS = range(1, 14)
_F8 = types.f8


@kernel(types.void(MECHANICS_TYPE, MEMORY_TYPE, array_of(_F8), array_of(_F8)))
def imposed(mechanics: Any, memory: Any, pressure_kpa: np.ndarray, angle_deg: np.ndarray) -> None:
    """The rig's mechanics under an imposed pressure, which runs straight between samples."""
    h = SAMPLE_S / SUBSTEPS
    x, k, s, total = np.zeros(5), np.zeros(5), np.zeros(5), np.zeros(5)
    x[0] = x[2] = x[3] = x[4] = mechanics.rest_deg
    memory.angle_deg, memory.inertia = mechanics.rest_deg, 1.0
    for n in range(len(pressure_kpa)):
        angle_deg[n] = x[0]
        following = pressure_kpa[min(n + 1, len(pressure_kpa) - 1)]
        for m in range(SUBSTEPS):
            total[:] = 0.0
            for stage in range(4):
                share = 0.0 if stage == 0 else 1.0 if stage == 3 else 0.5
                for i in range(5):
                    s[i] = x[i] + share * h * k[i] if stage > 0 else x[i]
                at = (m + share) / SUBSTEPS
                pressure = pressure_kpa[n] * (1.0 - at) + following * at
                k[0] = s[1]
                k[1] = acceleration(mechanics, memory, s[0], s[1], pressure, s[2], s[3], s[4])
                for i in range(N_CREEP):
                    k[2 + i] = mechanics.creep_rate[i] * (s[0] - s[2 + i])
                weight = 1.0 if stage in (0, 3) else 2.0
                for i in range(5):
                    total[i] += weight * k[i]
            for i in range(5):
                x[i] += h / 6.0 * total[i]
            advance_memory(mechanics, memory, x[0])


@kernel(types.void(THETA_TYPE, array_of(_F8), _F8, _F8, array_of(_F8)))
def free_run(theta: np.ndarray, pressure_kpa: np.ndarray, angle_deg: float, rate_deg_s: float, out: np.ndarray) -> None:
    """Eq. 2 alone, from the pressure and the first state."""
    y, v, h = angle_deg, rate_deg_s, SAMPLE_S / SUBSTEPS
    for n in range(len(pressure_kpa)):
        out[n] = y
        following = pressure_kpa[min(n + 1, len(pressure_kpa) - 1)]
        for m in range(SUBSTEPS):
            slope = (following - pressure_kpa[n]) / SUBSTEPS
            p = pressure_kpa[n] + slope * m
            k1 = bending_acceleration(theta, y, v, p)
            k2 = bending_acceleration(theta, y + 0.5 * h * v, v + 0.5 * h * k1, p + 0.5 * slope)
            k3 = bending_acceleration(theta, y + 0.5 * h * (v + 0.5 * h * k1), v + 0.5 * h * k2, p + 0.5 * slope)
            k4 = bending_acceleration(theta, y + h * (v + 0.5 * h * k2), v + h * k3, p + slope)
            y += h * v + h * h / 6.0 * (k1 + k2 + k3)
            v += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def multi_sine(top_hz: float, seed: int) -> np.ndarray:
    """Settling at the first value, then 80 s of sines of equal size and random phase, scaled to the range."""
    t = np.arange(round(SECONDS / SAMPLE_S)) * SAMPLE_S
    hz = np.linspace(top_hz / SINES, top_hz, SINES)
    phase = np.array([2.0 * np.pi * uniform(seed, 1, i) for i in range(SINES)])
    wave = np.sin(2.0 * np.pi * hz[:, None] * t + phase[:, None]).sum(axis=0)
    wave = LOW_KPA + (HIGH_KPA - LOW_KPA) * (wave - wave.min()) / (wave.max() - wave.min())
    return np.concatenate((np.full(round(SETTLE_S / SAMPLE_S), wave[0]), wave))


def measure(mechanics: Any, pressure_kpa: np.ndarray, seed: int) -> np.ndarray:
    angle = np.zeros(len(pressure_kpa))
    imposed(mechanics, new_record(MEMORY), pressure_kpa, angle)
    return angle + NOISE_DEG * np.array([gaussian(seed, 2, n) for n in range(len(angle))])


def least_squares(pressure_kpa: np.ndarray, y: np.ndarray, cutoff: float) -> np.ndarray:
    """Eqs. 6 to 10 with H_f = (cutoff / (s + cutoff))^3; theta in the order of Eq. 24."""

    def filtered(signal: np.ndarray, derivatives: int) -> np.ndarray:
        s_form = [cutoff**3] + [0.0] * derivatives, [1.0, 3.0 * cutoff, 3.0 * cutoff**2, cutoff**3]
        return lfilter(*bilinear(*s_form, fs=1.0 / SAMPLE_S), signal)

    columns = [-filtered(y, 0), filtered(y**2, 0), -filtered(y**3, 0)]
    columns += [(-1.0 if k % 2 == 0 or k == 3 else 1.0) * filtered(y ** (k + 1) / (k + 1), 1) for k in range(4)]
    columns += [filtered(np.ones_like(y), 0), filtered(pressure_kpa, 0)]
    start = round(SETTLE_S / SAMPLE_S)
    scale = np.array([np.abs(c[start:]).max() for c in columns])
    phi = np.stack(columns, axis=1)[start:] / scale
    theta = np.zeros(N_THETA)
    theta[:9] = np.linalg.lstsq(phi, filtered(y, 2)[start:], rcond=None)[0] / scale
    return theta


def fit(theta: np.ndarray, pressure_kpa: np.ndarray, y: np.ndarray) -> float:
    start = round(SETTLE_S / SAMPLE_S)
    simulated = np.zeros(len(y) - start)
    free_run(theta, pressure_kpa[start:].copy(), y[start], 0.0, simulated)
    measured = y[start:]
    if not np.all(np.isfinite(simulated)):
        return float("-inf")
    return 100.0 * (1.0 - np.linalg.norm(measured - simulated) / np.linalg.norm(measured - measured.mean()))


def scaled(seed: int, hysteresis: float, creep: float) -> Any:
    """The rig's mechanics with hysteresis and creep taken times a factor."""
    mechanics = draw_rig("rig", seed, load_parameters(shipped())).mechanics
    mechanics.stop_stiffness *= hysteresis
    mechanics.creep_stiffness *= creep
    return mechanics


def fits(mechanics: Any, seed: int, cutoff: float) -> tuple[float, float, float]:
    """Fit on the training data, on other data in [0, 1] Hz, and in [0, 0.5] Hz; %."""
    train, same, slow = (multi_sine(hz, 1000 * seed + i) for i, hz in enumerate((1.0, 1.0, 0.5)))
    angles = [measure(mechanics, p, seed + i) for i, p in enumerate((train, same, slow))]
    theta = least_squares(train, angles[0], cutoff)
    first, second, third = (fit(theta, p, y) for p, y in zip((train, same, slow), angles, strict=True))
    return first, second, third


def main() -> None:
    print(f"hysteresis {HYSTERESIS_DEG_S2} deg/s2, creep {CREEP_1_S2} 1/s2; NRMSE fit in %: train, [0, 1] Hz, [0, 0.5] Hz")
    print("seed 1, sizes times a factor, cutoff 20 rad/s:")
    for factor in (0.0, 0.5, 0.75, 1.0, 1.5, 2.0):
        print(f"  {factor:4.2f}  " + "  ".join(f"{f:6.2f}" for f in fits(scaled(1, factor, factor), 1, 20.0)))
    for cutoff in CUTOFFS_RAD_S:
        print(f"cutoff {cutoff:g} rad/s:")
        table = np.array([fits(scaled(seed, 1.0, 1.0), seed, cutoff) for seed in SEEDS])
        for seed, row in zip(SEEDS, table, strict=True):
            print(f"  seed {seed:2d}  " + "  ".join(f"{f:6.2f}" for f in row))
        print("  median   " + "  ".join(f"{f:6.2f}" for f in np.median(table, axis=0)))


if __name__ == "__main__":
    main()
