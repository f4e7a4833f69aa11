"""Eqs. 50 and 51 on the ideal layer: parametric mismatch only, ARC beside SMC with the same gains.

The plant is the controller's own model, with every parameter of the mechanics, and the leak, drawn inside its bounds; sensors
keep resolution and sampling, and lose their noise. What is left of the error is then the law's, and the sampling's.
"""

from __future__ import annotations

import tempfile
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from numpy.typing import NDArray

from softloop.controller.config import ActuationConfig, ArcConfig, ControllerConfig, SmcConfig
from softloop.controller.setup import build
from softloop.dynamics.parameters import B0, load_parameters, model_record, shipped
from softloop.offline.closed_loop import Run, simulate_run
from softloop.offline.trials import judge
from softloop.plant.config import PlantConfig

PAPER_RATIOS = {"t1_max_deg": 0.92, "t1_steady_deg": 0.53, "t2_max_deg": 0.70}
# Robust terms weak enough that the mismatch shows, adaptation fast enough that one run shows what it does.
_SHARED = {"k_s": 8.0, "k1": 12.0, "k2": 40.0, "rho": 10.0, "epsilon1": 1e7, "epsilon2": 1e7, "delta1": 0.0, "delta2": 0.0}
GAMMA = 1e-4


def perturbed(seed: int, folder: Path) -> Path:
    """A parameter file whose mechanics and leak lie anywhere inside Table 1's bounds."""
    content = tomlkit.parse(shipped().read_text())
    rng = np.random.RandomState(seed)
    entries = [*content["bending"].values(), content["pneumatics"]["leak_m2"]]
    for entry in entries:
        entry["value"] = float(entry["min"] + rng.uniform() * (entry["max"] - entry["min"]))
    path = folder / f"rig{seed}.toml"
    path.write_text(tomlkit.dumps(content))
    return path


def controller(law: str, trajectory: str) -> ControllerConfig:
    """The two laws with the same gains; modes from the flow demand, without a hold."""
    actuation = ActuationConfig(flow_hold_kpa_s=1.0, error_hold_deg=0.0, error_release_deg=0.0)
    arc = ArcConfig(**_SHARED, gamma=GAMMA, gamma_valve=1e-6)
    return ControllerConfig(law=law, trajectory=trajectory, actuation=actuation, arc=arc, smc=SmcConfig(**_SHARED))


def run_law(law: str, trajectory: str, parameters: Path) -> Run:
    """One run on the ideal layer, sensors without noise."""
    quiet = dict.fromkeys(("pressure_noise_kpa", "angle_noise_deg", "rate_noise_deg_s", "coil_noise_ma"), 0.0)
    plant = PlantConfig(layer="ideal", seed=1, parameters=str(parameters), **quiet)
    return simulate_run(controller(law, trajectory), plant)


def lyapunov(run: Run, law: str, parameters: Path) -> NDArray[np.float64]:
    """V3 = (S1^2 + rho S2^2 + theta~^T Gamma^-1 theta~) / 2 over the trajectory, (n,); the mechanics' parameters."""
    built = build(controller(law, "t2"))
    true = model_record(load_parameters(parameters)).theta
    cycles = run.cycles[run.cycles["trajectory_ns"] >= 0]
    gains = built.gains[0].arc
    apart = cycles["theta"][:, : B0 + 1] - true[: B0 + 1]
    parameters_part = (apart**2 / gains.gamma[: B0 + 1]).sum(axis=1) if law == "arc" else 0.0
    return np.asarray(0.5 * (cycles["s1_deg_s"] ** 2 + gains.rho * cycles["s2_kpa"] ** 2 + parameters_part))


def compare(seed: int) -> dict[str, Any]:
    """Both laws on one rig."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = perturbed(seed, Path(folder))
        for law in ("smc", "arc"):
            one, two = run_law(law, "t1", path), run_law(law, "t2", path)
            t1, t2 = judge(one), judge(two)
            v3 = lyapunov(two, law, path)
            found[law] = {
                "t1_max_deg": t1.max_deg,
                "t1_steady_deg": t1.steady_deg,
                "t2_max_deg": t2.max_deg,
                "t2_rms_deg": t2.rms_deg,
            }
            found[law] |= {"v3_start": float(v3[:200].mean()), "v3_end": float(v3[-200:].mean())}
            s1 = two.cycles["s1_deg_s"][two.cycles["trajectory_ns"] >= 0]
            found[law]["s1_max_deg_s"] = float(np.abs(s1).max())
    # Eq. 50: V2 <= epsilon / (2 lambda) in the end, so |S1| <= sqrt(epsilon / lambda).
    epsilon = _SHARED["epsilon1"] + _SHARED["rho"] * _SHARED["epsilon2"]
    found["s1_bound_deg_s"] = sqrt(epsilon / min(_SHARED["k1"], _SHARED["k2"]))
    found["ratio"] = {name: found["arc"][name] / found["smc"][name] for name in (*PAPER_RATIOS, "t2_rms_deg")}
    return found
