import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from math import inf
from pathlib import Path

import numpy as np
import psutil
import pytest

from softloop.controller.config import ControllerConfig
from softloop.deploy.batch import rig_tables, seeds_of
from softloop.deploy.bench import find_bench, load_bench, shipped_benches
from softloop.offline import campaign
from softloop.offline.campaign import Case, Group, Result, case_tables, influences, judge, plan_cases
from softloop.offline.closed_loop import simulate_tables
from softloop.offline.pools import run_here, run_in_processes, run_on_dask
from softloop.offline.scores import Scores, run_scores
from softloop.plant.mismatch import draw
from softloop.wire.errors import EXIT_INTERRUPTED, EXIT_OK, EXIT_USAGE, BadConfig, Unavailable
from softloop.wire.schedule import START_NS

TRAJECTORY = "t_s,value\n" + "".join(f"{0.25 * k},{60.0 + 8.0 * np.sin(0.25 * k) ** 2}\n" for k in range(13))


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A bench with a trajectory of 3 s, and its file."""
    folder = tmp_path_factory.mktemp("bench")
    (folder / "way.csv").write_text(TRAJECTORY)
    file = folder / "short.toml"
    text = f'base = "{shipped_benches()["sim"]}"\n[run]\nfolder = "{folder}/runs"\n'
    file.write_text(f'{text}[controller]\ntrajectory = "{folder}/way.csv"\napproach_s = 1.0\n')
    return file


@pytest.fixture(scope="module")
def tables(short):
    return rig_tables(load_bench(short))


@pytest.fixture(scope="module")
def results(tables):
    """Of three rigs under two laws, in this process, by case."""
    cases = plan_cases(("arc", "pid"), (tables.controller.trajectory,), range(3), payload=True)
    return {r.case: r for r in run_here(tables, cases)}


def softloop(*arguments, timeout=120):
    command = [sys.executable, "-m", "softloop.deploy.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False, stdin=subprocess.DEVNULL)


def test_a_case_is_the_run_of_its_seed_law_and_trajectory(tables, results):
    case = Case("pid", tables.controller.trajectory, 2)
    controller = tables.controller.model_copy(update={"law": "pid"})
    run = simulate_tables(replace(tables, controller=controller, plant=tables.plant.model_copy(update={"seed": 2})))
    assert results[case].scores == run_scores(run)
    assert len({r.scores for r in results.values()}) == len(results) == 12


def test_the_payload_comes_and_leaves_on_the_trajectory_and_shows(tables, results):
    case = Case("arc", tables.controller.trajectory, 0, payload=True)
    own, changes = case_tables(tables, case)
    run = simulate_tables(own)
    loaded = run.truths["load"] != 0
    stamps = run.truths["stamp_ns"][loaded]
    assert stamps[0] - changes[0] <= 5_000_000
    assert changes[1] - stamps[-1] <= 5_000_000
    assert run.truths["load_deg_s2"][loaded].min() < -200.0
    assert not run.truths["load_deg_s2"][~loaded].any()
    assert changes == tuple(START_NS + round((1.5 + 3.0 * share) * 1e9) for share in campaign.PAYLOAD_SPAN)
    scores, plain = results[case].scores, results[replace(case, payload=False)].scores
    assert scores.peak_deg is not None
    assert scores.peak_deg > plain.rms_error_deg
    assert plain.peak_deg is None


def test_processes_give_the_results_of_this_one(tables, results):
    assert {r.case: r for r in run_in_processes(tables, list(results), 1)} == results


def test_a_broken_worker_is_said_and_what_is_wrong_in_a_worker_too(tables):
    cases = [Case("arc", "nowhere.csv", 0)]
    with pytest.raises(BadConfig, match=r"nowhere\.csv"):
        list(run_in_processes(tables, cases, 1))


def test_closing_the_work_half_way_leaves_no_process(tables):
    cases = plan_cases(("arc",), ("t2",), range(40), payload=False)
    work = run_in_processes(tables, cases, 1)
    next(work)
    work.close()
    names = [" ".join(child.cmdline()) for child in psutil.Process().children(recursive=True)]
    assert not [name for name in names if "forkserver" in name and "from multiprocessing.spawn" in name]


@pytest.mark.long
def test_two_dask_workers_give_the_results_of_this_process(tables, results):
    distributed = pytest.importorskip("distributed", reason="the extra 'dask' is not installed")
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None, silence_logs=50
    )
    try:
        found = list(run_on_dask(tables, list(results), cluster.scheduler_address))
    finally:
        cluster.close()
    assert {r.case: r for r in found} == results


def test_a_dask_scheduler_that_is_not_there_is_said(tables, monkeypatch):
    pytest.importorskip("distributed", reason="the extra 'dask' is not installed")
    monkeypatch.setattr("softloop.offline.pools.CONNECT_S", 0.5)
    with pytest.raises(Unavailable, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        list(run_on_dask(tables, [Case("arc", "t1", 0)], "tcp://127.0.0.1:9"))


def a_result(seed, error, steady=None, **more):
    return Result(Case("arc", "t1", seed), Scores(error, steady, error / 3, 1.0), **more)


def test_a_verdict_names_spread_share_and_the_worst():
    results = [a_result(k, 1.0 + 0.1 * k, 0.5 if k < 15 else 0.9) for k in range(20)]
    verdict = judge(Group("arc", "t1"), results)
    spread = verdict.spreads["max_error_deg"]
    assert (spread.median, spread.p95, spread.worst) == pytest.approx((2.0, 2.9, 2.9))
    assert verdict.under_paper == {"max_error_deg": 1.0, "steady_error_deg": 0.75, "both": 0.75}
    assert verdict.worst.case.seed == 19
    assert "peak_deg" not in verdict.spreads
    assert verdict.influences == []


def test_a_lost_run_is_the_worst_and_under_nothing():
    lost = a_result(1, inf, inf, fault="SENSOR_AGE", completed=False)
    verdict = judge(Group("arc", "t1"), [a_result(0, 1.0, 0.5), lost])
    assert verdict.lost == 1
    assert verdict.worst is lost
    assert verdict.under_paper["both"] == 0.5
    assert verdict.spreads["max_error_deg"].worst == inf


def test_the_draw_that_makes_errors_large_is_found():
    seeds = range(60)
    errors = np.array([np.exp(-3.0 * draw(seed).supply) for seed in seeds])
    errors[np.argmin([draw(seed).supply for seed in seeds])] = inf
    name, rank = influences(seeds, errors)[0]
    assert (name, round(rank, 6)) == ("supply", -1.0)


@pytest.mark.parametrize(("text", "seeds"), [("7", range(7, 8)), ("0:1000", range(1000)), ("5:7", range(5, 7))])
def test_seeds(text, seeds):
    assert seeds_of(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "3:3", "4:3", "-1:2", "0:2000000", "1:2:3", "0:"])
def test_bad_seeds_are_said(text):
    with pytest.raises(BadConfig, match=re.escape(f"--seeds '{text}'")):
        seeds_of(text)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("sim", "--seeds", "x"), "--seeds 'x'"),
        (("sim", "--seeds", "1", "--law", "lqr"), "--law 'lqr': there is no such law; there are: pid, "),
        (("sim", "--seeds", "1", "--law", "pressure"), "a campaign judges angles"),
        (("sim", "--seeds", "1", "--trajectory", "t9"), "'t9'"),
        (("real", "--seeds", "1"), "has no [plant]"),
        (("sim", "--seeds", "1", "--jobs", "0"), "--jobs"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(tmp_path, arguments, said):
    done = softloop("batch", *arguments, "--out", tmp_path / "out")
    assert done.returncode == EXIT_USAGE
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_command_leaves_json_and_pictures_and_says_the_table(short, tmp_path, results):
    done = softloop("batch", short, "--seeds", "0:3", "--law", "arc,pid", "--payload", "--out", tmp_path)
    assert (done.returncode, done.stderr) == (EXIT_OK, "")
    assert "worst rig is seed" in done.stdout
    assert f"campaign: {tmp_path}" in done.stdout
    report = json.loads((tmp_path / "batch.json").read_text())
    by_case = {(r["law"], r["seed"], r["payload"]): r["max_error_deg"] for r in report["runs"]}
    assert by_case == {(c.law, c.seed, c.payload): r.scores.max_error_deg for c, r in results.items()}
    assert report["versions"]["numba"]
    assert set(report["git"]) == {"commit", "dirty"}
    assert report["bench"]["controller"]["approach_s"] == 1.0
    assert report["groups"][0]["worst"]["drawn"]["volume"] == draw(report["groups"][0]["worst"]["seed"]).volume
    assert (tmp_path / "batch.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (tmp_path / "batch.svg").read_bytes()


def test_json_is_all_of_standard_output(short, tmp_path):
    done = softloop("batch", short, "--seeds", "1", "--json", "--out", tmp_path)
    assert json.loads(done.stdout) == json.loads((tmp_path / "batch.json").read_text())
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("begun", "used_s"), [(1, 0.0), (1, 1.0), (2, 0.3)], ids=["helper begun", "fork server loads", "worker at work"]
)
def test_ctrl_c_ends_the_command_and_its_workers(tmp_path, begun, used_s):
    command = [sys.executable, "-m", "softloop.deploy.cli", "batch", "sim", "--seeds", "0:5000", "--jobs", "2", "--out", tmp_path]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True) as child:
        try:
            workers = _wait_for_workers(child.pid, begun, used_s)
            os.killpg(child.pid, signal.SIGINT)
            _, said = child.communicate(timeout=60)
        finally:
            child.kill()
    assert (child.returncode, said) == (EXIT_INTERRUPTED, "softloop: interrupted\n")
    assert not psutil.wait_procs(workers, timeout=20)[1]
    assert not list(tmp_path.iterdir())


def _wait_for_workers(pid, wanted, used_s, timeout_s=60.0):
    """The command's processes (fork server, resource tracker, workers) once so many of them have used so much processor time."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        children = psutil.Process(pid).children(recursive=True)
        if sum(c.cpu_times().user >= used_s for c in children) >= wanted:
            return children
        time.sleep(0.01)
    raise AssertionError("no worker came")


def test_the_shipped_bench_is_a_whole_rig():
    assert isinstance(rig_tables(load_bench(find_bench(Path("sim")))).controller, ControllerConfig)


def test_tuned_gains_replace_the_benchs():
    tables = rig_tables(load_bench(find_bench(Path("sim"))))
    own, _ = case_tables(tables, Case("arc_eso", "t2", 3))
    best, _ = case_tables(tables, Case("arc_eso", "t2", 3, tuned=True))
    assert own.controller.law == best.controller.law == "arc_eso"
    assert best.controller.trajectory == "t2"
    assert own.controller.arc_eso != best.controller.arc_eso
    assert best.controller.actuation.modes == "latched"
