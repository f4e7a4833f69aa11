"""The excitation experiments of the paper, in one process: the pressure law on its multi-sines, in halves: Data1 and Data2."""

from __future__ import annotations

from softloop.controller.config import ControllerConfig
from softloop.offline.closed_loop import simulate_run
from softloop.offline.identification.series import Series, from_cycles
from softloop.plant.config import PlantConfig

FAST = "excitation_1hz"


def halves(run: Series) -> tuple[Series, Series]:
    """Data1 and Data2 of a [0, 1] Hz run."""
    return run.part("Data1", 0.0, 0.5), run.part("Data2", 0.5, 1.0)


def excite(trajectory: str, plant: PlantConfig, trajectory_seed: int, parameters: str = "table1") -> Series:
    """One simulated run of the pressure law; `parameters` is what the law believes."""
    controller = ControllerConfig(law="pressure", trajectory=trajectory, trajectory_seed=trajectory_seed, parameters=parameters)
    return from_cycles(simulate_run(controller, plant).cycles, f"{trajectory}, rig {plant.seed}")
