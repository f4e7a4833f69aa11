"""Experiments as commands: what is refused before anything moves, what each run's bench is, and whole ones in one process."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from softloop.deploy.bench import find_bench, load_bench
from softloop.deploy.experiment import Asked, begin, bench_file, run_all
from softloop.deploy.experiment_pressure import check_envelope, controller_of
from softloop.deploy.experiment_tracking import check_laws, paper_of
from softloop.deploy.experiment_valves import check, check_supplies
from softloop.wire.errors import BadConfig, Unavailable


def softloop(*words, cwd, timeout=300):
    command = [sys.executable, "-m", "softloop.deploy.cli", *map(str, words)]
    return subprocess.run(
        command, cwd=cwd, capture_output=True, text=True, timeout=timeout, check=False, stdin=subprocess.DEVNULL
    )


def bench_with(folder, text, base="sim"):
    file = folder / "bench.toml"
    file.write_text(f'base = "{find_bench(Path(base))}"\n{text}')
    return file


def test_a_runs_bench_is_the_bench_with_another_law_and_nothing_else(tmp_path):
    for name in ("sim", "real"):
        shipped = find_bench(Path(name))
        place = begin(Asked(shipped, tmp_path / name), "pressure")
        file = bench_file(
            place, "excitation_1hz", {"controller": controller_of("pressure", "excitation_1hz", place.bench.controller)}
        )
        made, base = load_bench(file).model_dump(), load_bench(shipped).model_dump()
        assert (made["controller"]["law"], made["controller"]["trajectory"]) == ("pressure", "excitation_1hz")
        assert made | {"controller": None} == base | {"controller": None}


def test_what_a_bench_states_of_its_rig_is_not_the_tuned_gains(tmp_path):
    """A rig's lags and budgets are its own; where its bench says nothing of them, those hold that the law was tuned with."""
    stated = "pressure_budget_ms = 100.0\nactuation_delay_ms = 9.0\n"
    place = begin(Asked(bench_with(tmp_path, f"[controller]\n{stated}"), tmp_path / "x"), "pressure")
    table = {"controller": controller_of("pressure_eso", "excitation_1hz", place.bench.controller)}
    made = load_bench(bench_file(place, "one", table)).controller
    assert (made.pressure_budget_ms, made.actuation_delay_ms, made.inclination_budget_ms) == (100.0, 9.0, 30.0)
    assert made.observer.teach_kpa == 60.0
    assert controller_of("pressure_eso", "excitation_1hz", None)["actuation_delay_ms"] == 1.412


def test_parameters_and_seed_of_the_command_reach_the_run(tmp_path):
    place = begin(Asked(find_bench(Path("sim")), tmp_path / "x", parameters="firm", seed=9), "pressure")
    file = bench_file(place, "one", {"controller": {"law": "pressure", "trajectory": "excitation_1hz"}})
    controller = tomllib.loads(file.read_text())["controller"]
    assert (controller["parameters"], controller["trajectory_seed"]) == ("firm", 9)


def test_the_first_run_that_fails_is_the_last(tmp_path, monkeypatch):
    place = begin(Asked(find_bench(Path("sim")), tmp_path / "x"), "pressure")
    started = []
    monkeypatch.setattr(
        "softloop.deploy.experiment.run_one", lambda place, name, changes: started.append(name) or len(started) - 1
    )
    assert run_all(place, {"a": {}, "b": {}, "c": {}}) == 1
    assert started == ["a", "b"]


def test_a_bench_without_a_controller_or_a_folder_that_cannot_be_is_refused(tmp_path):
    file = bench_with(tmp_path, 'without = ["controller"]\n')
    with pytest.raises(BadConfig, match=r"needs the table \[controller\]"):
        begin(Asked(file, tmp_path / "x"), "pressure")
    (tmp_path / "file").write_text("")
    with pytest.raises(Unavailable, match="cannot be made"):
        begin(Asked(find_bench(Path("sim")), tmp_path / "file" / "x"), "pressure")


def test_a_used_folder_is_refused_before_the_first_run_by_the_option_that_named_it(tmp_path):
    place = begin(Asked(find_bench(Path("sim")), tmp_path / "x"), "pressure")
    (tmp_path / "x" / "b").mkdir()
    (tmp_path / "x" / "b" / "bench.toml").write_text("")
    with pytest.raises(Unavailable, match="holds the run 'b' already; name another folder with --out"):
        run_all(place, {"a": {}, "b": {}})
    assert not (tmp_path / "x" / "a.toml").exists()


@pytest.mark.parametrize("pace", ["batch", "lockstep"])
def test_a_real_rig_at_a_simulated_pace_is_refused_in_the_words_that_asked_for_it(tmp_path, pace):
    with pytest.raises(BadConfig, match=rf"real\.toml: --pace {pace}: {pace} needs the tables \[plant\]"):
        begin(Asked(find_bench(Path("real")), tmp_path / "x", pace), "pressure")
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(("limit", "refused"), [(119.9, True), (120.0, False)])
def test_an_excitation_must_fit_into_the_gates_envelope(tmp_path, limit, refused):
    place = begin(Asked(bench_with(tmp_path, f"[valves]\npressure_max_kpa = {limit}\n"), tmp_path / "x"), "pressure")
    if refused:
        with pytest.raises(BadConfig, match="leaves no room"):
            check_envelope(place)
    else:
        check_envelope(place)


def test_flow_tests_need_a_tank_that_the_bench_declares(tmp_path):
    place = begin(Asked(find_bench(Path("sim")), tmp_path / "x"), "valves")
    with pytest.raises(BadConfig, match=r"no table \[calibration\] that declares a tank"):
        check(place, (150.0, 175.0, 200.0), ratios=False)
    check(place, (150.0, 175.0, 200.0), ratios=True)


@pytest.mark.parametrize(
    ("text", "supplies", "word"),
    [
        ("", (150.0, 200.0, 200.0), "3 different pressures"),
        ("", (150.0, 175.0, 200.0, 200.0), "twice"),
        ("", (150.0, 175.0, 900.0), r"900 kPa: must be .* at most 240, the limit of plant.supply_kpa"),
        ("", (100.0, float("nan"), float("inf")), "nan kPa: must be"),
        ("", (150.0, 175.0, float("inf")), "inf kPa: must be"),
        ("", (150.0, -175.0, 200.0), "-175 kPa: must be above 20"),
        ("", (0.0, 175.0, 200.0), "0 kPa: must be above 20"),
        ("[pressures.supply]\nspan_kpa = 180.0\n", (150.0, 175.0, 200.0), "at most 180, pressures.supply.span_kpa"),
        ("[valves]\npressure_max_kpa = 165.0\n", (150.0, 175.0, 200.0), "at least 10 kPa below"),
    ],
)
def test_flow_tests_that_would_say_too_little_or_go_too_far_are_refused(tmp_path, text, supplies, word):
    place = begin(Asked(bench_with(tmp_path, text, "sim_tank"), tmp_path / "x"), "valves")
    with pytest.raises(BadConfig, match=word):
        check(place, supplies, ratios=False)


def test_a_real_supply_is_bounded_by_what_its_sensor_reads(tmp_path):
    place = begin(Asked(bench_with(tmp_path, "[calibration]\ntank_ml = 500.0\n", "real"), tmp_path / "x"), "valves")
    check_supplies(place, (150.0, 200.0, 250.0))
    for bad in (900.0, float("nan"), float("inf"), -5.0):
        with pytest.raises(BadConfig, match=r"at most 250, pressures.supply.span_kpa of its sensor"):
            check_supplies(place, (150.0, 200.0, bad))


def test_somebody_must_be_there_to_set_a_real_supply(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.stdin.isatty", lambda: False)
    place = begin(Asked(bench_with(tmp_path, "[calibration]\ntank_ml = 500.0\n", "real"), tmp_path / "x"), "valves")
    with pytest.raises(BadConfig, match="somebody at a terminal"):
        check(place, (150.0, 175.0, 200.0), ratios=False)


@pytest.mark.parametrize("laws", [(), ("pressure",), ("arc", "fuzzy"), ("valve_test",)])
def test_tracking_is_for_laws_that_follow_an_angle(laws):
    with pytest.raises(BadConfig, match="tracking is for pid, pid_eso, smc, arc, arc_eso"):
        check_laws(laws)


def test_the_papers_numbers_stand_beside_their_laws():
    assert paper_of("arc", "t1") == (4.36, 0.82)
    assert paper_of("smc", "t2") == (5.27, None)
    assert paper_of("arc_eso", "t1") == (None, None)


@pytest.mark.long
def test_from_the_experiment_to_a_run_on_what_was_identified(tmp_path):
    """Pressure experiment, identification, a run with the file: the whole way, by its commands."""
    done = softloop("experiment", "pressure", "sim", "--pace", "batch", "--out", "p", cwd=tmp_path)
    assert done.returncode in (0, 1), done.stderr
    result = json.loads((tmp_path / "p" / "pressure.json").read_text())
    assert set(result) == {"excitation_1hz", "excitation_05hz"}
    assert (done.returncode == 0) == all(r["max_kpa"] <= 2.0 for r in result.values())
    assert (tmp_path / "p" / "fig2ab.png").stat().st_size > 10_000
    runs = ["p/excitation_1hz", "p/excitation_05hz"]
    assert softloop("log", "check", runs[0], cwd=tmp_path).returncode == 0
    done = softloop("identify", *runs, "--output", "own.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    words = ("experiment", "tracking", "sim", "--pace", "batch", "--laws", "arc", "--parameters", "own.toml", "--out", "t")
    done = softloop(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "t" / "tracking.json").read_text())
    assert all(row["max_deg"] < 10.0 for row in found.values())
    assert "own" in (tmp_path / "t" / "arc_t1" / "parameters.toml").read_text()


@pytest.mark.long
def test_over_many_rigs_the_bar_decides_the_exit_code(tmp_path):
    done = softloop("experiment", "pressure", "sim", "--over", "100:101", "--json", cwd=tmp_path)
    runs = json.loads(done.stdout)["runs"]
    assert {len(errors) for errors in runs.values()} == {1}
    assert done.returncode == (0 if max(max(errors) for errors in runs.values()) <= 2.0 else 1)
    done = softloop("experiment", "pressure", "real", "--over", "0:1", cwd=tmp_path)
    assert (done.returncode, "no table [plant]" in done.stderr) == (2, True)


@pytest.mark.long
def test_a_limit_that_is_passed_ends_the_experiment_with_exit_code_1(tmp_path):
    bench_with(tmp_path, "[valves]\nangle_max_deg = 90.0\n")
    done = softloop("experiment", "pressure", "bench.toml", "--pace", "batch", "--out", "p", cwd=tmp_path)
    assert done.returncode == 1
    assert "FAULT: over_angle" in done.stderr
    assert not (tmp_path / "p" / "excitation_05hz").exists()
    assert len(done.stderr.strip().splitlines()) <= 2


@pytest.mark.long
def test_flow_tests_on_a_tank_and_on_the_actuator(tmp_path):
    bench_with(tmp_path, "[controller.valve_test]\nlevels = 4\n", "sim_tank")
    done = softloop("experiment", "valves", "bench.toml", "--pace", "batch", "--out", "v", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "v" / "valves.json").read_text())
    assert found["charge"]["rank"] == 5
    assert found["exhaust"]["not_identifiable"] == ["ratio"]
    assert (tmp_path / "v" / "fig4.png").is_file()
    done = softloop("experiment", "valves", "sim", "--ratios", "--pace", "batch", "--out", "r", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "r" / "valves.json").read_text())
    assert "V" in found["charge"]["not_identifiable"]
    assert set(found["charge"]["numbers"]) <= {"k_v1_m2_ma / V", "k_v2_pa", "k_v3_m2_pa / V", "k_v6_m2 / V", "ratio"}
    done = softloop("experiment", "valves", "sim", "--pace", "batch", cwd=tmp_path)
    assert (done.returncode, len(done.stderr.strip().splitlines())) == (2, 1)
    done = softloop("experiment", "valves", "sim_tank", "--supply", "high", cwd=tmp_path)
    assert (done.returncode, len(done.stderr.strip().splitlines())) == (2, 1)
