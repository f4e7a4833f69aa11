"""Runs started from the page, with a stand-in for `softloop run`."""

import asyncio
import sys
import time
import tomllib
from pathlib import Path

import pytest
from tests.watch.pages import until

from softloop.deploy import experiments as module
from softloop.deploy.bench import find_bench, load_bench
from softloop.deploy.experiments import Experiments

TOY = """
import pathlib, signal, sys, time
print("running", flush=True)
signal.signal(signal.SIGINT, lambda *_: (print("softloop: interrupted (SIGINT)", flush=True), sys.exit(130)))
print(open(sys.argv[2]).read().replace(chr(10), "|"), flush=True)
end = time.monotonic() + 30
while time.monotonic() < end and not pathlib.Path(sys.argv[0]).with_name("enough").exists():
    time.sleep(0.02)
print("run: runs/toy", flush=True)
"""


@pytest.fixture
def runs(tmp_path, monkeypatch):
    (tmp_path / "toy.py").write_text(TOY)
    monkeypatch.setattr(module, "PROGRAM", (sys.executable, str(tmp_path / "toy.py")))
    file = find_bench(Path("sim"))
    with Experiments(load_bench(file), file) as made:
        yield made


def start(runs, **asked):
    return asyncio.run(runs.start(asked))


def test_a_run_is_started_with_what_was_asked_and_its_end_is_told(runs, tmp_path):
    told = []
    runs.on_change = lambda: told.append(runs.state()["text"])
    assert start(runs, law="pid", trajectory="t2", duration_s=5) == {}
    assert "error" in start(runs, law="arc")
    (tmp_path / "enough").touch()
    until(lambda: runs.state()["text"].startswith("ended with code 0: run: runs/toy"))
    assert runs.state() | {"text": ""} == {"running": False, "text": "", "law": "pid", "trajectory": "t2"}
    assert told[0] == "starting"


def test_the_bench_of_a_run_is_the_pages_own_with_another_law(runs):
    assert start(runs, law="pid", trajectory="t2") == {}
    file = next(Path(runs._folder.name).glob("*.toml"))
    content = tomllib.loads(file.read_text())
    assert content["controller"] == {"law": "pid", "trajectory": "t2"}
    bench = load_bench(file)
    assert (bench.name, bench.controller.law, bench.plant.layer) == ("sim", "pid", "rig")


def test_ending_is_as_ctrl_c(runs):
    assert asyncio.run(runs.end({})) == {"error": "no experiment of this page is running"}
    assert start(runs, law="arc") == {}
    until(lambda: "running" in runs._child.log.read_text())
    time.sleep(0.3)
    assert asyncio.run(runs.end({})) == {}
    until(lambda: runs.state()["text"] == "ended with code 130: interrupted (SIGINT)")


@pytest.mark.parametrize("asked", [{"law": "fuzzy"}, {"law": "arc", "duration_s": "long"}, {"law": "arc", "duration_s": [1]}])
def test_what_cannot_be_run_is_said_and_nothing_starts(runs, asked):
    answer = start(runs, **asked)
    assert answer["error"]
    assert "\n" not in answer["error"]
    assert not runs.running
