"""On measurements of others: every folder of CSV files with t_s, bend_deg and one or more P*_kPa under `--real-data DIR`.

The run with the largest range of angle trains, by rule and not by choice; all others must be simulated from their pressures.
"""

import csv
from pathlib import Path

import numpy as np

from softloop.offline.identification.csv_map import parse_map, read_csv
from softloop.offline.identification.fitting import fit_output_error
from softloop.offline.identification.output_error import score
from softloop.offline.identification.structure import Structure


def pressures(path):
    with path.open(encoding="utf-8") as file:
        header = next(csv.reader(file))
    found = [name for name in header if name.startswith("P") and name.endswith("_kPa")]
    return found if {"t_s", "bend_deg"} <= set(header) else []


def campaigns(folder):
    groups = {}
    for path in sorted(Path(folder).rglob("*.csv")):
        columns = pressures(path)
        if columns:
            entries = ["time=t_s", "angle=bend_deg", f"pressure={','.join(columns)}"]
            groups.setdefault(path.parent, []).append(read_csv(path, parse_map(entries)))
    return [sorted(g, key=lambda s: -np.ptp(s.angle_deg)) for g in groups.values() if len(g) > 1]


def test_memory_simulates_unseen_runs_better_than_the_linear_model(real_data):
    found = campaigns(real_data)
    assert found, f"{real_data}: no folder with two or more CSV files of t_s, bend_deg and P*_kPa"
    for train, *unseen in found:
        inputs = train.pressure_kpa.shape[1]
        memory = fit_output_error(Structure(inputs=inputs, hysteresis=1, creep=1, at_rest=True), [train])
        linear = fit_output_error(Structure(m=0, r=0, inputs=inputs), [train])
        for run in unseen:
            assert score(memory, run) > max(score(linear, run), 90.0), run.name
