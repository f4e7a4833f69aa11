import os
import signal
import subprocess
import sys
import time

import pytest

from softloop.deploy import children as module
from softloop.deploy.children import Children
from softloop.wire.errors import EXIT_LOST

# A stand-in for a process: it says a word, then does what its first argument says.
PROGRAM = """
import os, signal, sys, time
what, fd = sys.argv[1], int(sys.argv[-1])
if what == "deaf":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
if what == "polite":
    signal.signal(signal.SIGTERM, lambda *_: (print("goodbye", flush=True), sys.exit(0)))
print("ready", flush=True)
if what == "fails":
    print("[toy] the cable is out", file=sys.stderr)
    sys.exit(3)
if what == "lifeline":
    os.read(fd, 1)
    sys.exit(0)
time.sleep(30)
"""


@pytest.fixture
def program(tmp_path):
    file = tmp_path / "toy.py"
    file.write_text(PROGRAM)
    return (sys.executable, str(file))


@pytest.fixture
def children(program):
    made = Children(program)
    yield made
    made.close()


def wait_for(condition, timeout_s=10.0):
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


def start(children, tmp_path, what):
    child = children.start(what, [what], tmp_path / f"{what}.log")
    wait_for(lambda: "ready" in child.log.read_text())
    return child


def test_a_child_that_fails_is_found_with_its_code_and_last_word(children, tmp_path):
    start(children, tmp_path, "polite")
    failed = start(children, tmp_path, "fails")
    wait_for(lambda: children.ended() is not None)
    assert children.ended() is failed
    assert failed.exit_code_for_a_person() == 3
    assert failed.epitaph() == "process 'fails' ended with code 3: [toy] the cable is out"


def test_a_child_that_is_killed_counts_as_lost(children, tmp_path):
    child = start(children, tmp_path, "polite")
    os.kill(child.pid, signal.SIGKILL)
    wait_for(lambda: children.ended() is not None)
    assert child.exit_code_for_a_person() == EXIT_LOST
    assert "killed by SIGKILL" in child.epitaph()


class Naps:
    """A clock that counts how long it was slept, with `meanwhile` for what happens in each sleep."""

    def __init__(self, meanwhile):
        self.now_s, self.meanwhile = 0.0, meanwhile

    def monotonic(self):
        return self.now_s

    def sleep(self, seconds):
        time.sleep(seconds)
        self.meanwhile()
        self.now_s += seconds


def test_stop_asks_first_and_kills_only_the_deaf(children, tmp_path, monkeypatch):
    polite, deaf = start(children, tmp_path, "polite"), start(children, tmp_path, "deaf")
    # How long the polite one takes to end is this machine's affair: for it, time stands still.
    monkeypatch.setattr(module, "time", Naps(lambda: deaf.killed and polite.popen.wait(30)))
    killed = children.stop((("deaf",), ("polite",)), timeout_s=0.3)
    assert killed == [deaf]
    assert polite.exit_code() == 0
    assert polite.last_line() == "goodbye"


def test_stop_wakes_a_frozen_child_by_killing_it(children, tmp_path):
    child = start(children, tmp_path, "polite")
    os.kill(child.pid, signal.SIGSTOP)
    assert children.stop((("polite",),), timeout_s=0.3) == [child]
    assert child.exit_code() == -signal.SIGKILL


def test_children_see_the_launcher_die(program, tmp_path):
    """A launcher that is killed outright: its children end by the lifeline, which none of them holds open for the others."""
    logs = [tmp_path / "a.log", tmp_path / "b.log"]
    launcher = f"""
import time
from pathlib import Path
from softloop.deploy.children import Children
children = Children({program!r})
for name in {[str(log) for log in logs]!r}:
    print(children.start(name, ["lifeline"], Path(name)).pid, flush=True)
time.sleep(30)
"""
    with subprocess.Popen([sys.executable, "-c", launcher], stdout=subprocess.PIPE, text=True) as process:
        pids = [int(process.stdout.readline()) for _ in logs]
        wait_for(lambda: all(log.exists() and "ready" in log.read_text() for log in logs))
        process.kill()
    wait_for(lambda: not any(_runs(pid) for pid in pids))


def _runs(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
