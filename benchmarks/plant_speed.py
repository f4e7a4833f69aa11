"""How fast is the simulated rig? CPU time of `run_until` under the currents of T2, best of several runs.

python benchmarks/plant_speed.py
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from logged_currents import Currents, of_closed_loop
from numba import types

from softloop.devices.protocols.quantise_kernels import current_to_counts
from softloop.plant.config import PlantConfig
from softloop.plant.electrical import accept_command, run_until
from softloop.plant.records import EVENT, EVENTS_TYPE, PLANT_TYPE, STATE_TYPE
from softloop.plant.setup import new_device, new_state, plant_record
from softloop.wire.kernel import array_of, kernel

SECONDS = 20.0
REPEATS = 7
_I8, _F8 = types.i8, types.f8


@kernel(types.void(PLANT_TYPE, STATE_TYPE, array_of(_I8), array_of(_F8), array_of(_F8), EVENTS_TYPE))
def loop(params: Any, state: Any, end_ns: np.ndarray, charge: np.ndarray, exhaust: np.ndarray, events: np.ndarray) -> None:
    """What a batch does with the plant: a command, then on to the next."""
    for n in range(len(end_ns)):
        accept_command(params, state, end_ns[n], current_to_counts(charge[n]), current_to_counts(exhaust[n]), 1, n)
        while state.reached_ns < end_ns[n]:
            run_until(params, state, end_ns[n], events)


def measure(layer: str, step_us: int, currents: Currents) -> tuple[float, float, float]:
    """(ns per step, steps per second of rig time, times real time)."""
    config = PlantConfig.model_validate({"layer": layer, "step_us": step_us})
    params, events, best, steps = plant_record(config), np.zeros(64, EVENT), float("inf"), 0
    for _ in range(REPEATS):
        state = new_state(params, new_device(config), 0)
        begin = time.process_time()
        loop(params, state, currents.end_ns, currents.charge_ma, currents.exhaust_ma, events)
        best, steps = min(best, time.process_time() - begin), int(state.steps)
    return 1e9 * best / steps, steps / SECONDS, SECONDS / best


def main() -> None:
    for layer in ("ideal", "rig"):
        currents = of_closed_loop(layer).until(SECONDS)
        for step_us in (1000, 500, 400, 250, 100):
            step_ns, steps, times = measure(layer, step_us, currents)
            print(f"{layer:5s}  step {step_us:4d} us  {step_ns:5.0f} ns per step  {steps:6.0f} steps/s  {times:6.0f} x real time")


if __name__ == "__main__":
    main()
