"""What the controller will ask for, beside the gate's limits: refused before anything moves."""

import pytest

from softloop.deploy.bench import load_bench, shipped_benches
from softloop.deploy.prepare import check_controller
from softloop.wire.errors import BadConfig

REST_KPA = "pressure_max_kpa = 100.0\n"


def bench(folder, tables):
    (folder / "b.toml").write_text(f'base = "{shipped_benches()["sim"]}"\nname = "b"\n{tables}')
    return load_bench(folder / "b.toml")


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ("[valves]\nangle_max_deg = 90.0\n", "'valves.angle_max_deg': the trajectory 't1' goes to 130.0 deg"),
        ("[valves]\nangle_min_deg = 75.0\n", "'valves.angle_min_deg': the trajectory 't1' goes to"),
        ("[valves]\nvent_current_ma = 180.0\ncurrent_max_ma = 200.0\n", "the gate faults above 200 mA, the controller"),
        ("[valves]\nvent_current_ma = 0.01\n", "'valves.vent_current_ma': 0.01 mA vents 10 kPa at 0 kPa/s"),
        ("[valves]\nvent_current_ma = 100.0\n", "full current does at"),
        (f'[valves]\n{REST_KPA}[controller]\nlaw = "pressure"\ntrajectory = "excitation_1hz"\n', "goes to 110.0 kPa"),
    ],
)
def test_what_the_gate_would_end_in_a_fault_is_refused(tmp_path, tables, said):
    with pytest.raises(BadConfig, match="key 'valves") as caught:
        check_controller(bench(tmp_path, tables))
    assert said in str(caught.value)


@pytest.mark.parametrize(
    "tables",
    [
        "[valves]\nvent_current_ma = 150.0\n",
        "[valves]\nangle_max_deg = 131.0\nangle_min_deg = 20.0\n",
        '[valves]\nangle_max_deg = 90.0\n[controller]\nlaw = "pressure"\ntrajectory = "excitation_1hz"\n',
        f'[valves]\n{REST_KPA}angle_max_deg = 90.0\n[controller]\nlaw = "valve_test"\ntrajectory = "valve_steps"\n',
    ],
)
def test_what_fits_is_not(tmp_path, tables):
    assert check_controller(bench(tmp_path, tables)) > 0.0


def test_every_shipped_bench_fits():
    for file in shipped_benches().values():
        check_controller(load_bench(file))
