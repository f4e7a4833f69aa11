"""`softloop identify` from a log to a parameter file that a bench takes or refuses."""

import hashlib
import json

import numpy as np
import pytest
from test_valve_flow import flow_tests

from softloop.deploy import cli
from softloop.deploy.bench import load_bench
from softloop.deploy.prepare import check_identity
from softloop.dynamics.parameters import load_parameters, model_record
from softloop.offline.identification.coverage import true_values
from softloop.offline.identification.structure import PAPER
from softloop.wire.errors import BadConfig


def softloop(*arguments):
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    return ended.value.code


@pytest.fixture(scope="module")
def parameters(excitation, tmp_path_factory):
    file = tmp_path_factory.mktemp("out") / "identified.toml"
    assert softloop("identify", excitation, "--output", file) == 0
    return file


def test_the_file_holds_values_bounds_and_where_they_come_from(parameters, excitation):
    loaded = load_parameters(parameters)
    model_record(loaded)
    evidence = loaded.evidence
    errors = np.sqrt(np.diag(evidence.covariance))
    for name, truth, error in zip(PAPER.names, true_values(), errors, strict=True):
        entry = getattr(loaded.bending, name)
        assert 0.0 < entry.max - entry.value <= 3.0 * error * (1.0 + 1e-6)
        assert entry.max - entry.value == pytest.approx(entry.value - entry.min)
        assert abs(entry.value - truth) < 5.0 * error, name
    assert evidence.rig == "bench-a"
    assert [run.trained for run in evidence.runs] == [True, False]
    assert {run.sha256 for run in evidence.runs} == {hashlib.sha256(excitation.read_bytes()).hexdigest()}
    assert min(run.fit_percent for run in evidence.runs) > 99.0
    assert evidence.runs[0].end_s < evidence.runs[1].start_s


def bench_on(folder, parameters, name, run=""):
    file = folder / f"{name}.toml"
    file.write_text(f'name = "{name}"\n[run]\n{run}\n[controller]\nparameters = "{parameters}"\n')
    return load_bench(file)


def test_another_rig_s_bench_refuses_the_file_and_says_how_to_override(parameters, tmp_path):
    check_identity(bench_on(tmp_path, parameters, "bench-a"))
    check_identity(bench_on(tmp_path, parameters, "bench-b", 'rig = "bench-a"'))
    check_identity(bench_on(tmp_path, parameters, "bench-b", "foreign_parameters = true"))
    with pytest.raises(BadConfig, match=r"on rig 'bench-a' and this is 'bench-b'.*run.foreign_parameters = true"):
        check_identity(bench_on(tmp_path, parameters, "bench-b"))


def test_the_answer_as_json_and_as_a_picture(excitation, tmp_path, capsys):
    picture = tmp_path / "fit.png"
    assert softloop("identify", excitation, "--method", "iv", "--json", "--figure", picture) == 0
    answer = json.loads(capsys.readouterr().out)
    assert set(answer["parameters"]) == set(PAPER.names)
    assert answer["validate"]["Data2"] > 99.0
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        ((), "needs either runs, or --csv"),
        (("RUN", "--csv", "x.csv"), "not both"),
        (("RUN", "--orders", "2,3"), "must be m,n,r"),
        (("RUN", "--orders", "2,0,9"), "each order is 0 to 6"),
        (("RUN", "--method", "ls", "--creep", "1"), "takes neither memory"),
        (("RUN", "--orders", "1,0,1", "--output", "x.toml"), "orders 2,0,3"),
        (("--venting", "--csv", "x.csv", "--train", "3", "--map", "time=t", "--map", "pressure=p"), "must be 1 to 1"),
    ],
)
def test_what_cannot_be_done_is_one_line(excitation, capsys, arguments, fault):
    assert softloop("identify", *(excitation if a == "RUN" else a for a in arguments)) == 2
    error = capsys.readouterr().err
    assert fault in error
    assert error.count("\n") == 1


def test_coverage_counts_and_writes(tmp_path, capsys):
    file = tmp_path / "counted.json"
    assert softloop("coverage", "--rigs", 2, "--first-seed", 7, "--output", file, "--json") == 0
    counted = json.loads(file.read_text())
    assert counted == json.loads(capsys.readouterr().out)
    assert (counted["rigs"], counted["asked_rigs"], counted["first_seed"]) == (2, 2, 7)
    row = counted["methods"]["oe coloured"]["b0"]
    assert row["low"] <= row["held"] <= row["high"]
    assert 0.0 < row["half_percent"] < 1.0


def test_flow_tests_of_one_pressure_are_answered_with_no(tmp_path, capsys):
    columns = [f"--map={key}={key}" for key in ("current", "upstream", "downstream", "flow")]
    for supplies, downstreams, code in (((100.0, 150.0, 200.0), (0.0, 50.0, 90.0), 0), ((200.0,), (0.0,), 1)):
        tests = flow_tests(supplies, downstreams)
        rows = np.column_stack([tests.current_ma, tests.upstream_kpa, tests.downstream_kpa, tests.flow_kg_s])
        file = tmp_path / "flow.csv"
        np.savetxt(file, rows, delimiter=",", header="current,upstream,downstream,flow", comments="")
        assert softloop("valve", file, *columns, "--discharge", "0.8", "--json") == code
        answer = json.loads(capsys.readouterr().out)
        assert bool(answer["numbers"]) == (code == 0)
