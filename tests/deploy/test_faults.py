"""`softloop faults`: what is printed and kept, and its exit code; the runs themselves are in tests/rig."""

import json
from pathlib import Path

import pytest

from softloop.deploy import faults
from softloop.deploy.bench import find_bench
from softloop.deploy.faults import Result, run_all, run_with_faults
from softloop.deploy.launcher import Options
from softloop.deploy.scenario import shipped_scenarios
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK, BadConfig, BadFile, Unavailable


def result(name, expected, seen, **more):
    given = {"chamber_kpa": 18.44, "vent_s": 0.025, "empty_s": None, "events": [], "ended": "it ended", "run": "runs/x", **more}
    return Result(scenario=name, expected=expected, seen=seen, **given)


@pytest.fixture
def seen(monkeypatch):
    """Runs whose outcomes are given: scenario -> what is seen, VENT where nothing is said."""
    outcomes = {}

    def run_one(scenario, file, run_dir):
        assert run_dir.name == scenario.name
        return result(scenario.name, scenario.expected, outcomes.get(scenario.name, scenario.expected))

    monkeypatch.setattr(faults, "run_one", run_one)
    return outcomes


def test_all_as_expected_is_0_and_each_has_its_line(seen, tmp_path, capsys):
    assert run_all([Path("valves_killed"), Path("driver_power_loss")], tmp_path / "out", as_json=False) == EXIT_OK
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["scenario", "expected", "seen", "from", "kPa", "vent", "ms", "<", "5", "kPa", "ms"]
    assert lines[1].split() == ["valves_killed", "VENT", "VENT", "18.4", "25", "-"]
    assert lines[2].split() == ["driver_power_loss", "DEAD", "DEAD", "18.4", "25", "-"]
    assert lines[3] == "2 of 2 scenarios ended as expected"


def test_one_that_is_not_is_1_and_is_named_with_how_it_ended(seen, tmp_path, capsys):
    seen["valves_killed"] = "NONE"
    assert run_all([Path("valves_killed"), Path("driver_power_loss")], tmp_path, as_json=True) == EXIT_NEGATIVE
    answer = json.loads(capsys.readouterr().out)
    assert [row["as_expected"] for row in answer["scenarios"]] == [False, True]
    assert answer["as_expected"] is False
    assert answer == json.loads((tmp_path / "faults.json").read_text())
    run_all([Path("valves_killed")], tmp_path, as_json=False)
    assert capsys.readouterr().err == "softloop: valves_killed: expected VENT, seen NONE: it ended\n"


def test_of_many_events_the_first_are_printed_and_the_rest_counted(seen, capsys):
    faults._print_table([result("power", "DEAD", "DEAD", events=[f"{n}.000 s plant: said" for n in range(10)])])
    lines = capsys.readouterr().out.splitlines()[2:]
    assert lines == [f"    {n}.000 s plant: said" for n in range(8)] + ["    and 2 more"]


def test_a_folder_that_cannot_be_is_one_line(seen, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(Unavailable, match="cannot be written"):
        run_all([Path("valves_killed")], tmp_path / "file", as_json=False)


def test_a_mistake_in_the_last_scenario_is_found_before_any_runs(seen, tmp_path):
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(shipped_scenarios()["valves_killed"].read_text().replace("at_s = 2.0", "at_s = 50"))
    with pytest.raises(BadConfig, match=r"wrong\.toml: key 'injections\.0\.at_s': the run is over by then: armed for 4 s"):
        run_all([Path("valves_killed"), wrong], tmp_path / "out", as_json=False)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("options", "said"), [
    (Options(duration_s=0.1, pace="wall"), "key 'injections.0.at_s': the run is over by then: armed for 0.1 s"),
    (Options(pace="lockstep"), "key 'injections.0': kind 'process_kill' needs wall pace"),
])  # fmt: skip
def test_what_the_command_line_makes_impossible_is_said_of_the_scenario(tmp_path, options, said):
    file = tmp_path / "mine.toml"
    file.write_text(shipped_scenarios()["valves_killed"].read_text().replace("at_s = 2.0", "at_s = 9"))
    with pytest.raises(BadConfig) as caught:
        run_with_faults(find_bench(Path("sim")), file, options)
    assert str(caught.value).startswith(f"{file}: {said}")


def test_an_unknown_scenario_is_found_before_any_runs(seen, tmp_path):
    with pytest.raises(BadFile, match="no such scenario"):
        run_all([Path("valves_killed"), Path("nowhere")], tmp_path / "out", as_json=False)
    assert not (tmp_path / "out").exists()
