"""The documentation's commands, carried out: beside one quick rig run, as runs of their own, and on the logs that these left.

They stand in a folder where `sim` is a bench file of that name: the shipped one with ports of the test's own, budgets that a busy
machine keeps, and a trajectory that lasts until somebody ends it. What is asked for is what the page says but for `LESS`.
"""

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest
from tests.docs.test_documentation import ALL, ROOT
from tests.rig.test_whole_rig import WIDE
from tests.wire.rendezvous import short_folder

from softloop.deploy.bench import shipped_benches

pytestmark = pytest.mark.commands

LIMIT_S = 120.0
STOP = ["request", "sim", "stop"]
FIRST = ["run", "sim", "--page", "--run-dir", "runs/first"]
SECOND = ["run", "pid.toml", "--run-dir", "runs/second"]
OFFLINE = ("experiment", "identify", "valve", "coverage", "fits", "reproduce", "shadow", "evaluate")  # test_offline_commands.py
BESIDE = ("top", "echo", "page", "foxglove", "request")
ON_LOGS = ("plot", "report", "compare", "replay", "keys")
ELSEWHERE = ("doctor", "install", "log", "parity", "wt931", "canopen", "calibrate")  # in tests of their own
STANDS_FOR = {"runs/<run>": "runs/first", "runs/RUN": "runs/first", "runs/RUN_A": "runs/first", "runs/RUN_B": "runs/second"}
# What is long in the documentation is short here: these words are added, or stand in for others.
LESS = {
    "run": (["--duration", "1", "--no-report"], {}),
    "top": (["--seconds", "1"], {}),
    "echo": (["--count", "2"], {}),
    "batch": (["--jobs", "1"], {"0:100": "0:1"}),
    "request": ([], {"0.5": "0.001"}),  # a fault so short that the gate does not react: the rig is still needed
}
SOMETHING_HAPPENS = ["request", "sim", "fault", "noise", "--size", "0.1", "--for", "0.1"]  # two events
# What ends by Ctrl-C alone, and what it says when it is there.
SERVERS = {"page": "live page: ", "foxglove": "ws://"}


def commands(*names):
    """The documentation's commands of these names, each once."""
    found = {tuple(command): page for page, command in ALL if command[0] in names and list(command) not in (FIRST, SECOND, STOP)}
    return [pytest.param(list(command), id=f"{page}: {' '.join(command)}") for command, page in found.items()]


def less(command):
    """A command with fewer numbers, and its placeholders replaced."""
    more, instead = LESS.get(command[0], ([], {}))
    if "--faults" in command:
        more = []  # the scenario says how long
    if command[0] == "faults" and all(word.startswith("-") for word in command[1:]):
        more = ["can_bus_off"]  # of all the shipped ones
    return [instead.get(STANDS_FOR.get(word, word), STANDS_FOR.get(word, word)) for word in command] + more


class Place:
    """A folder in which commands are run, with sockets and benches of its own."""

    def __init__(self, folder):
        self.folder = folder
        self.environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder)}
        times = np.arange(0.0, 600.0, 0.05)
        np.savetxt(folder / "wave.csv", np.c_[times, 60 + 10 * np.sin(times / 3)], delimiter=",", header="t_s,angle_deg")
        for name, shipped in (
            ("sim", "sim"),
            ("sim.toml", "sim"),
            ("sim_t2", "sim_t2"),
            ("my_bench.toml", "sim"),
            ("my_rig.toml", "sim"),
        ):
            (folder / name).write_text(
                f'base = "{shipped_benches()[shipped]}"\n{WIDE}[page]\nport = 0\n[foxglove]\nport = 0\n'
                f'[controller]\ntrajectory = "{folder}/wave.csv"\napproach_s = 2.0\n'
                "pressure_budget_ms = 100.0\ninclination_budget_ms = 100.0\n"
            )
        text = re.search(r"^```toml\n(.*?)^```", (ROOT / "docs" / "tutorial.md").read_text(), re.S | re.M)[1]
        (folder / "pid.toml").write_text(text)
        text = re.search(r"^```toml\n(.*?)^```", (ROOT / "docs" / "faults.md").read_text(), re.S | re.M)[1]
        (folder / "bad_cable.toml").write_text(text)
        text = re.search(r"^```toml\n(.*?)^```", (ROOT / "docs" / "security.md").read_text(), re.S | re.M)[1]
        (folder / "rig.toml").write_text(text)

    def start(self, words, output):
        command = [sys.executable, "-m", "softloop.deploy.cli", *words]
        return subprocess.Popen(
            command, cwd=self.folder, env=self.environment, stdout=output, stderr=output, stdin=subprocess.DEVNULL
        )

    def run(self, words, meanwhile=None, limit_s=LIMIT_S):
        """Carry a command out, `meanwhile` again and again until it has ended; its exit code and what it said."""
        with self.said("done.txt") as (file, output):
            process = self.start(words, output)
            until = time.monotonic() + LIMIT_S
            while meanwhile and process.poll() is None and time.monotonic() < until:
                end(self.start(meanwhile, subprocess.DEVNULL))
            return end(process, limit_s), file.read_text()

    @contextmanager
    def said(self, name):
        file = self.folder / name
        with file.open("w") as output:
            yield file, output

    @contextmanager
    def serving(self, words, name, word):
        """A command that goes on while the block runs, from when it has said `word`."""
        with self.said(name) as (file, output):
            process = self.start(words, output)
            try:
                wait_for(lambda: word in file.read_text(), process, file)
                yield process, file
            finally:
                if process.poll() is None:
                    process.send_signal(signal.SIGINT)
                end(process)


def end(process, limit_s=LIMIT_S):
    """The exit code; a process that does not end is killed, and the test fails."""
    try:
        return process.wait(limit_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        raise


def wait_for(condition, process, file):
    until = time.monotonic() + LIMIT_S
    while not condition():
        assert process.poll() is None, file.read_text()
        assert time.monotonic() < until, file.read_text()
        time.sleep(0.05)


@pytest.fixture(scope="module")
def place():
    with short_folder() as folder:
        yield Place(folder)


@pytest.fixture(scope="module")
def first(place):
    """The tutorial's first run, going on; it leaves runs/first."""
    with place.serving(FIRST, "first.txt", "gate armed") as (process, file):
        yield process, file


@pytest.mark.parametrize("command", commands(*BESIDE, "check"))
def test_beside_a_running_rig(place, first, command):
    process, file = first
    assert process.poll() is None, file.read_text()
    words = ["sim" if word == "sim_can" else word for word in less(command)]  # one rig runs, whichever a page speaks of
    if command[0] in SERVERS and "--layout" not in command:
        with place.serving(words, "served.txt", SERVERS[command[0]]):
            return
    code, said = place.run(words, meanwhile=SOMETHING_HAPPENS if command[:2] == ["echo", "event"] else None)
    assert code == 0, said
    assert said.strip()


def test_the_stop_ends_the_first_run(place, first):
    process, file = first
    code, said = place.run(STOP)
    assert code == 0, said
    assert end(process) == 1
    assert "FAULT: emergency stop" in file.read_text()


@pytest.mark.parametrize("command", [pytest.param(SECOND, id="tutorial.md: second"), *commands("run")])
def test_a_run(place, command):
    code, said = place.run(less(command))
    assert code == 0, said


@pytest.mark.parametrize("command", commands(*ON_LOGS, "batch", "faults"))
def test_on_what_is_there(place, command):
    code, said = place.run(less(command))
    assert code == 0, said


def test_every_command_of_the_pages_is_among_these():
    """A new kind of command on a page is a new line here."""
    assert {command[0] for _, command in ALL} <= {"run", "batch", "check", "faults", *BESIDE, *ON_LOGS, *OFFLINE, *ELSEWHERE}
    assert all(command in [command for _, command in ALL] for command in (FIRST, SECOND, STOP))
