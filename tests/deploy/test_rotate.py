"""The disk budget: what goes, what stays, and that no run in use is touched, whoever uses it."""

import os
import subprocess
import sys
import threading
import time

import pytest

from softloop.deploy import rotate
from softloop.deploy.bench import load_bench
from softloop.deploy.rotate import GOING, KEEP, MIB, claimed, fit, in_use, keeping_budget, make_room, prune, runs_of
from softloop.deploy.run_dir import keep_bench
from softloop.watch.recorder import Sink
from softloop.wire.errors import BadConfig, Unavailable


class Runs:
    """A folder of runs, each a mebibyte and a little, one second younger than the one before."""

    def __init__(self, folder):
        self.folder = folder
        self.file = folder / "b.toml"
        self.made = 0

    def bench(self, budget_mib=0, over_budget="refuse", name="mine"):
        self.file.write_text(
            f'name = "{name}"\n[run]\nfolder = "{self.folder}/runs"\n[recorder]\nbudget_mib = {budget_mib}\n'
            f'over_budget = "{over_budget}"\n'
        )
        return load_bench(self.file)

    def make(self, name, bench_name="mine", n_bytes=MIB, log="run.mcap"):
        path = self.folder / "runs" / name
        path.mkdir(parents=True)
        keep_bench(path, self.bench(name=bench_name))
        if log:
            (path / log).write_bytes(bytes(n_bytes))
        self.made += 1
        os.utime(path / "bench.toml", (1000 + self.made, 1000 + self.made))
        return path

    def there(self):
        return sorted(path.name for path in (self.folder / "runs").iterdir())


@pytest.fixture
def runs(tmp_path):
    return Runs(tmp_path)


def test_the_oldest_go_until_the_rest_fits(runs):
    for name in ("c", "a", "b"):  # by age, not by name
        runs.make(name)
    gone, total = fit(runs.bench(), round(2.5 * MIB))
    assert ([run.path.name for run in gone], runs.there()) == (["c"], ["a", "b"])
    assert 2 * MIB < total <= 2.5 * MIB
    assert fit(runs.bench(), round(2.5 * MIB))[0] == []


def test_what_is_no_run_of_this_bench_is_neither_counted_nor_removed(runs, tmp_path):
    runs.make("mine")
    runs.make("theirs", bench_name="other")
    runs.make("no-log", log=None)
    (tmp_path / "runs" / "notes").mkdir()
    (tmp_path / "runs" / "notes" / "run.mcap").write_bytes(bytes(MIB))
    elsewhere = runs.make("elsewhere")
    elsewhere.rename(tmp_path / "elsewhere")
    (tmp_path / "runs" / "link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "runs" / "broken").mkdir()
    (tmp_path / "runs" / "broken" / "bench.toml").write_text("name = ")
    assert [run.path.name for run in runs_of(runs.bench())] == ["mine"]
    assert [run.path.name for run in fit(runs.bench(), 0)[0]] == ["mine"]
    assert runs.there() == ["broken", "link", "no-log", "notes", "theirs"]
    assert (tmp_path / "elsewhere" / "run.mcap").exists()


def test_a_run_that_is_to_be_kept_stays_and_counts(runs):
    (runs.make("old") / KEEP).touch()
    runs.make("new")
    gone, total = fit(runs.bench(), 0)
    assert ([run.path.name for run in gone], runs.there()) == (["new"], ["old"])
    assert total > MIB


def test_a_run_whose_launcher_or_recorder_lives_is_not_touched(runs):
    launched, recorded, free = runs.make("launched"), runs.make("recorded", log=None), runs.make("free")
    sink = Sink(recorded / "run.mcap")
    sink.write(bytes(MIB))
    sink.store()
    with in_use(launched):
        assert [run.path.name for run in fit(runs.bench(), 0)[0]] == [free.name]
        assert runs.there() == ["launched", "recorded"]
    assert [run.path.name for run in fit(runs.bench(), 0)[0]] == ["launched"]
    sink.close()
    assert [run.path.name for run in fit(runs.bench(), 0)[0]] == ["recorded"]


def test_a_later_part_of_a_log_in_use_protects_the_run_too(runs):
    path = runs.make("parts")
    sink = Sink(path / "run-2.mcap")
    with claimed(path) as free:
        assert not free
    sink.close()
    with claimed(path) as free:
        assert free


HOLD = """
import sys, time
from pathlib import Path
from softloop.watch.recorder import Sink
sink = Sink(Path(sys.argv[1]))
print("there", flush=True)
time.sleep(600)
"""


def test_a_recorder_that_was_killed_holds_nothing(runs):
    path = runs.make("killed", log=None)
    command = [sys.executable, "-c", HOLD, str(path / "run.mcap")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "there\n"
        assert fit(runs.bench(), -1)[0] == []
        process.kill()
        process.wait(30)
    assert [run.path.name for run in fit(runs.bench(), -1)[0]] == ["killed"]


def test_a_removal_that_was_interrupted_is_ended(runs):
    path = runs.make("half")
    (path / "bench.toml").unlink()
    path.rename(path.with_name(GOING + "half"))
    runs.make("new")
    assert fit(runs.bench(), 10 * MIB)[0] == []
    assert runs.there() == ["new"]


def test_a_new_run_is_refused_above_the_budget_and_nothing_is_removed(runs):
    runs.make("a")
    make_room(runs.bench())  # no budget
    make_room(runs.bench(budget_mib=2))
    runs.make("b")
    with pytest.raises(Unavailable, match=r"runs of bench 'mine' hold 2 MiB and \[recorder\] budget_mib is 2: see"):
        make_room(runs.bench(budget_mib=2))
    assert runs.there() == ["a", "b"]
    make_room(runs.bench(budget_mib=2, over_budget="remove"))
    assert runs.there() == ["b"]


def test_a_new_run_is_refused_when_what_is_left_may_not_go(runs):
    for name in ("a", "b"):
        (runs.make(name) / KEEP).touch()
    with pytest.raises(Unavailable):
        make_room(runs.bench(budget_mib=1, over_budget="remove"))
    assert runs.there() == ["a", "b"]


def test_the_budget_is_kept_while_a_run_grows_and_the_running_log_stays(runs, monkeypatch):
    monkeypatch.setattr(rotate, "LOOK_S", 0.02)
    for name in ("a", "b"):
        runs.make(name)
    running = runs.make("running", log=None)
    sink, said, heard = Sink(running / "run.mcap"), [], threading.Event()

    def say(line):
        said.append(line)
        heard.set()

    with keeping_budget(runs.bench(budget_mib=3, over_budget="remove"), say), in_use(running):
        for expected in (["b", "running"], ["running"], ["running"]):
            sink.write(bytes(MIB + 1000))
            sink.store()
            wait_for(lambda expected=expected: runs.there() == expected)
        sink.write(bytes(MIB))
        sink.store()
        wait_for(lambda: "none is left that may be removed" in said[-1])
    assert [line.split("'")[1] for line in said[:2]] == ["a", "b"]
    assert (running / "run.mcap").stat().st_size == 4 * MIB + 3000
    sink.close()


def wait_for(condition, timeout_s=20.0):
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def test_with_refuse_nothing_is_kept_beside_the_run(runs):
    before = threading.active_count()
    with keeping_budget(runs.bench(budget_mib=1), print):
        assert threading.active_count() == before


def test_prune_says_what_goes_and_does_it(runs, capsys):
    for name in ("a", "b"):
        runs.make(name)
    runs.bench(budget_mib=2)
    assert prune(runs.file, None, dry=True) == 0
    assert "would remove" in capsys.readouterr().out
    assert runs.there() == ["a", "b"]
    assert prune(runs.file, 2, dry=False) == 0
    assert runs.there() == ["b"]
    assert "removed" in capsys.readouterr().out
    with in_use(runs.folder / "runs" / "b"), pytest.raises(Unavailable, match="in use, or holds a file 'keep'"):
        prune(runs.file, 0, dry=False)
    runs.bench()
    with pytest.raises(BadConfig, match="say --budget MIB"):
        prune(runs.file, None, dry=False)
