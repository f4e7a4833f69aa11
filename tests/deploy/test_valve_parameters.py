"""From flow tests on a tank to a parameter file: what is taken, what is kept, what is refused, and one whole way."""

import hashlib
import tomllib
from pathlib import Path

import numpy as np
import pytest
from tests.deploy.test_experiment import bench_with, softloop

from softloop.deploy.bench import find_bench, load_bench
from softloop.deploy.experiment import Asked, begin
from softloop.deploy.experiment_valves import check_output, run_valves
from softloop.deploy.prepare import check_identity
from softloop.deploy.valve_parameters import METHOD, NotShown, _beside, _covariance, _sure, old_ratio, valve_table
from softloop.dynamics.parameters import load_parameters, model_record, shipped
from softloop.offline.identification.intervals import Uncertainty
from softloop.offline.identification.tank_tests import Volume
from softloop.offline.identification.valve_flow import NAMES, ValveFit
from softloop.wire.errors import BadConfig, BadFile

VALUES = np.array([4e-9, 6e-7, 4e-13, 2.5e-7, 0.4])
ERRORS = 0.01 * VALUES
OLD = {
    "k_v1_m2_ma": {"value": 5e-9, "min": 4e-9, "max": 6e-9},
    "k_v2_pa": 5e-7,
    "k_v3_m2_pa": 5e-13,
    "k_v4_pa": 2.5e-7,
    "k_v5_m2_pa": 2.5e-13,
    "k_v6_m2": {"value": 3e-7, "min": 2e-7, "max": 4e-7},
    "area_max_m2": 6e-7,
}


def sure_of(count=5):
    return Uncertainty(NAMES[:count], VALUES[:count], np.diag(ERRORS[:count] ** 2), 50.0, "white")


def test_measured_numbers_get_bounds_of_three_standard_errors_and_the_ratio_gives_the_other_two():
    table = valve_table(OLD, sure_of())
    assert list(table) == list(OLD)
    assert table["k_v1_m2_ma"] == pytest.approx({"value": 4e-9, "min": 3.88e-9, "max": 4.12e-9})
    assert table["k_v6_m2"] == pytest.approx({"value": 2.5e-7, "min": 2.425e-7, "max": 2.575e-7})
    assert (table["k_v4_pa"], table["k_v5_m2_pa"]) == pytest.approx((2.4e-7, 1.6e-13))
    assert table["area_max_m2"] == 6e-7


def test_a_valve_without_a_ratio_of_its_own_keeps_the_old_one():
    table = valve_table(OLD, sure_of(4))
    assert (table["k_v4_pa"], table["k_v5_m2_pa"]) == pytest.approx((3e-7, 2e-13))
    assert old_ratio(OLD | {"k_v2_pa": 0.0}) == pytest.approx(0.5)
    assert old_ratio(OLD | {"k_v2_pa": 0.0, "k_v3_m2_pa": 0.0}) == 0.0


def test_what_the_tests_do_not_show_makes_no_file():
    with pytest.raises(NotShown, match="of the charge valve do not show k_v6_m2") as caught:
        _sure("charge", ValveFit(sure_of(3), VALUES, 3, 99.0))
    assert caught.value.exit_code == 1
    with pytest.raises(NotShown, match="do not show k_v1_m2_ma, k_v2_pa, k_v3_m2_pa, k_v6_m2"):
        _sure("exhaust", ValveFit(None, VALUES, 0, 99.0))


def test_the_tanks_error_is_one_for_both_valves():
    found = _covariance({"charge": sure_of(), "exhaust": sure_of(4)}, Volume(5e-4, 0.02))
    assert found.shape == (9, 9)
    assert np.array_equal(found, found.T)
    assert found[0, 5] == pytest.approx((0.02 * VALUES[0]) ** 2)
    assert found[1, 6] == 0.0  # k_v2 has no volume in it


def test_evidence_of_the_bending_stays_and_that_of_older_valves_goes():
    ours = {"rig": "a", "method": METHOD, "softloop": "1", "parameters": ["charge.k"], "covariance": [[4.0]],
            "runs": [{"name": "supply_150", "sha256": "new"}]}  # fmt: skip
    old = {"rig": "a", "method": f"Eq. 2; {METHOD}", "parameters": ["a0", "charge.k"], "covariance": [[1.0, 9.0], [9.0, 2.0]],
           "runs": [{"name": "excitation_1hz", "sha256": "bent"}, {"name": "supply_150", "sha256": "old"}]}  # fmt: skip
    found = _beside(old, ours)
    assert found["method"] == f"Eq. 2; {METHOD}"
    assert (found["parameters"], found["covariance"]) == (["a0", "charge.k"], [[1.0, 0.0], [0.0, 4.0]])
    assert [run["sha256"] for run in found["runs"]] == ["bent", "new"]
    assert _beside(old | {"parameters": ["charge.k", "exhaust.k"]}, ours) == ours


def test_a_file_that_cannot_be_is_refused_before_anything_moves(tmp_path):
    tank = find_bench(Path("sim_tank"))
    place = begin(Asked(tank, tmp_path / "v"), "valves")
    with pytest.raises(BadFile, match="there is no folder"):
        check_output(place, tmp_path / "none" / "own.toml")
    with pytest.raises(BadFile, match="is a folder"):
        check_output(place, tmp_path)
    with pytest.raises(BadConfig, match="--ratios gives only ratios"):
        run_valves(Asked(tank, tmp_path / "r"), (150.0, 175.0, 200.0), ratios=True, output=tmp_path / "own.toml")
    assert not (tmp_path / "r").exists()


def test_values_of_another_rigs_bending_are_not_called_this_rigs(tmp_path):
    evidence = 'rig = "other"\nmethod = "m"\nsoftloop = "1"\nparameters = ["a0"]\ncovariance = [[1.0]]\nruns = []\n'
    (tmp_path / "other.toml").write_text(f"{shipped().read_text()}\n[evidence]\n{evidence}")
    text = f'[controller]\nparameters = "{tmp_path / "other.toml"}"\n'
    place = begin(Asked(bench_with(tmp_path, text, "sim_tank"), tmp_path / "v"), "valves")
    with pytest.raises(BadConfig, match="identified on rig 'other' and this is 'sim'"):
        check_output(place, tmp_path / "own.toml")


@pytest.mark.long
def test_the_simulated_valves_own_numbers_lie_within_the_files_bounds(tmp_path):
    """On the ideal layer, whose sensors have no errors that a tank cannot show."""
    bench_with(tmp_path, '[plant]\nlayer = "ideal"\n', "sim_tank")
    words = ("experiment", "valves", "bench.toml", "--pace", "batch", "--out", "v", "--output", "own.toml", "--quiet")
    done = softloop(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found, true = load_parameters(tmp_path / "own.toml"), load_parameters(shipped())
    model_record(found)
    for valve in ("charge", "exhaust"):
        measured, own = getattr(found, valve), getattr(true, valve)
        for name in ("k_v1_m2_ma", "k_v6_m2"):
            entry, truth = getattr(measured, name), getattr(own, name).value
            assert entry.min < truth < entry.max, (valve, name)
            assert entry.max - entry.min < 0.15 * truth, (valve, name)
        for name in ("k_v2_pa", "k_v3_m2_pa", "k_v4_pa", "k_v5_m2_pa"):
            assert getattr(measured, name) == pytest.approx(getattr(own, name), rel=0.1), (valve, name)
    assert (found.bending, found.pneumatics, found.name) == (true.bending, true.pneumatics, "own")
    logs = [next((tmp_path / "v" / f"supply_{kpa}").glob("*.mcap")) for kpa in (150, 175, 200)]
    assert [run.sha256 for run in found.evidence.runs] == [hashlib.sha256(log.read_bytes()).hexdigest() for log in logs]
    assert found.evidence.rig == "sim"
    assert "the exhaust valve's k_v4 / k_v2" in (tmp_path / "own.toml").read_text()
    assert tomllib.loads((tmp_path / "own.toml").read_text())["name"] == "own"
    tank = load_bench(bench_with(tmp_path, f'[controller]\nparameters = "{tmp_path / "own.toml"}"\n', "sim_tank"))
    check_identity(tank)
