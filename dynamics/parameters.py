"""Parameters of the model with their bounds, from their file (`parameter_file`) into the record that kernels read.

theta follows Eq. 24 (index i of the paper is i - 1 here), with one addition: the paper has one k_v1 and one k_v6 for two
physical valves; here the exhaust valve's stand in two further places.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from softloop.dynamics.parameter_file import Parameters, in_theta_order, load_parameters, shipped
from softloop.wire.errors import BadConfig
from softloop.wire.kernel import array_of, new_record, record_dtype, record_type

__all__ = [
    "B0", "KV1_CHARGE", "KV1_EXHAUST", "KV6_CHARGE", "KV6_EXHAUST", "LEAK", "MODEL", "MODEL_TYPE", "N_THETA", "THETA_NAMES",
    "THETA_TYPE", "VALVE_SHAPE", "VALVE_SHAPE_TYPE", "Parameters", "load_parameters", "model_record", "shipped",
]  # fmt: skip

N_THETA = 14
B0, KV1_CHARGE, KV6_CHARGE, LEAK, KV1_EXHAUST, KV6_EXHAUST = 8, 9, 10, 11, 12, 13
THETA_NAMES = (
    "a0",
    "-a1",
    "a2",
    "c0",
    "-c1",
    "c2",
    "c3",
    "d",
    "b0",
    "k_v1_charge",
    "k_v6_charge",
    "A_l",
    "k_v1_exhaust",
    "k_v6_exhaust",
)

VALVE_SHAPE = record_dtype([(n, "f8") for n in ("k_v2_pa", "k_v3_m2_pa", "k_v4_pa", "k_v5_m2_pa", "area_max_m2")])
MODEL = record_dtype(
    [
        ("theta", "f8", (N_THETA,)),
        ("theta_min", "f8", (N_THETA,)),
        ("theta_max", "f8", (N_THETA,)),
        ("charge", VALVE_SHAPE),
        ("exhaust", VALVE_SHAPE),
        ("volume_m3", "f8"),
        ("temperature_k", "f8"),
        ("discharge", "f8"),
        ("supply_kpa", "f8"),
        ("current_max_ma", "f8"),
    ]
)
VALVE_SHAPE_TYPE = record_type(VALVE_SHAPE)
MODEL_TYPE = record_type(MODEL)
THETA_TYPE = array_of(types.f8, 1, "A")


def model_record(parameters: Parameters) -> Any:
    """The `MODEL` record of a parameter file. Raises BadConfig when the record would not be usable."""
    model = new_record(MODEL)
    for index, entry in enumerate(in_theta_order(parameters)):
        model.theta[index], model.theta_min[index], model.theta_max[index] = entry
    for shape, valve in ((model.charge, parameters.charge), (model.exhaust, parameters.exhaust)):
        for name in VALVE_SHAPE.names or ():
            setattr(shape, name, getattr(valve, name))
    air = parameters.pneumatics
    for name in ("volume_m3", "temperature_k", "discharge", "supply_kpa", "current_max_ma"):
        setattr(model, name, getattr(air, name))
    if not np.all(np.isfinite(model.theta)):
        raise BadConfig(f"parameters '{parameters.name}': every value must be finite")
    return model
