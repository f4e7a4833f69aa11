"""A known model and data from it, for tests."""

import numpy as np

from softloop.offline.identification.coverage import true_values
from softloop.offline.identification.series import Series
from softloop.offline.identification.simulator import simulate
from softloop.offline.identification.structure import PAPER

SAMPLE_S = 0.005


def multi_sine(seed, seconds, top_hz=1.0):
    random = np.random.RandomState(seed)
    t = np.arange(0.0, seconds, SAMPLE_S)
    raw = sum(np.sin(2 * np.pi * top_hz * k / 12 * t + random.uniform(0, 2 * np.pi)) for k in range(1, 13))
    return t, 5.0 + 105.0 * (raw - raw.min()) / np.ptp(raw)


def values_of(structure, **extra):
    """Table 1 in the places of `structure`, with options by name."""
    values = np.zeros(structure.size)
    for name, value in zip(PAPER.names, true_values(), strict=True):
        values[structure.place(name)] = value
    for name, value in extra.items():
        values[structure.place(name)] = value
    return values


def measured(structure, values, seed=1, seconds=40.0, noise_deg=0.0, window_s=(-np.inf, np.inf)):
    t, pressure = multi_sine(seed, seconds)
    values = values.copy()
    a0, a1, a2, b0, d = (values[structure.place(name)] for name in ("a0", "a1", "a2", "b0", "d"))
    at_rest = np.roots([a2, a1, a0, -(b0 * pressure[0] + d)])
    values[-2] = min(at_rest[np.isreal(at_rest)].real)
    angle = np.empty(len(t))
    simulate(values, structure.layout, t, pressure[:, None].copy(), 2, angle)
    angle += noise_deg * np.random.RandomState(seed + 100).standard_normal(len(t))
    return Series(f"synthetic {seed}", t, pressure[:, None], angle, window_s)
