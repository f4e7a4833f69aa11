"""What the launcher does to processes, on real ones that only wait."""

import errno
import subprocess
import sys
import time
from types import SimpleNamespace

import psutil
import pytest

from softloop.deploy.children import Child
from softloop.deploy.injector import Injector
from softloop.deploy.launcher_events import LauncherEvents
from softloop.wire.fault_config import FaultsConfig, InjectionConfig
from softloop.wire.messages import constant, message, names_of

FAULTS = {name: number for number, name in names_of("Event", "FAULT_").items()}
# For each line that it is given: "ok", or the number of the error.
WRITER = """
import sys
for line in sys.stdin:
    try:
        with open({0!r}, "ab", buffering=0) as file:
            file.write(b"x" * 100)
        print("ok", flush=True)
    except OSError as error:
        print(error.errno, flush=True)
"""


class Rig:
    """A gate that is armed or not, one process, and what was said of it."""

    def __init__(self, tmp_path, code="import time; time.sleep(60)", **injection):
        self.popen = subprocess.Popen(
            [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )
        self.said, self.started = [], []
        self.state = SimpleNamespace(armed=False, valves=SimpleNamespace(stamp_ns=0))
        children = SimpleNamespace(all={injection["target"]: Child(injection["target"], self.popen, tmp_path / "log")})
        wire = SimpleNamespace(publisher=lambda channel: lambda payload: self.said.append(message("Event").unpack(payload)))
        bench = SimpleNamespace(
            faults=FaultsConfig(injections=(InjectionConfig(at_s=0.0, **injection),)), recorder=SimpleNamespace(file="run.mcap")
        )
        self.injector = Injector(bench, tmp_path, LauncherEvents(wire), children, self.started.append)

    def act(self, armed=True, there=True):
        if armed and not self.state.armed:
            self.state.armed, self.state.valves.stamp_ns = True, time.monotonic_ns()
        self.injector.act(self.state, there=there)
        return [(event.reason, event.code) for event in self.said]

    def status(self, wanted):
        """Whether the process comes to a status; the kernel takes a moment."""
        end = time.monotonic() + 5.0
        while psutil.Process(self.popen.pid).status() != wanted and time.monotonic() < end:
            time.sleep(0.01)
        return psutil.Process(self.popen.pid).status() == wanted


@pytest.fixture
def rig(tmp_path):
    made = []

    def make(**options):
        made.append(Rig(tmp_path, **options))
        return made[-1]

    yield make
    for one in made:
        one.popen.kill()
        one.popen.communicate()


def test_nothing_is_done_before_the_gate_is_armed(rig):
    one = rig(kind="process_kill", target="controller")
    assert one.act(armed=False) == []
    assert one.popen.poll() is None
    assert one.act() == [(FAULTS["process_kill"], 1)]
    assert one.popen.poll() is not None
    assert one.said[0].kind == constant("Event", "KIND_FAULT")
    assert one.started == []


def test_a_stopped_process_goes_on_when_it_is_over(rig):
    one = rig(kind="process_stop", target="valves", duration_s=0.2)
    assert one.act() == [(FAULTS["process_stop"], 1)]
    assert one.status(psutil.STATUS_STOPPED)
    time.sleep(0.25)
    assert one.act()[1:] == [(FAULTS["process_stop"], 0)]
    assert one.status(psutil.STATUS_SLEEPING)


def test_a_process_is_started_anew(rig):
    one = rig(kind="process_restart", target="controller")
    one.act()
    assert one.popen.poll() is not None
    assert one.started == ["controller"]


def test_what_is_done_to_a_process_that_is_not_there_is_not_said(rig):
    one = rig(kind="process_stop", target="valves", duration_s=0.01)
    one.popen.kill()
    one.popen.wait()
    assert one.act() == []
    time.sleep(0.02)
    assert one.act() == []


def test_a_full_disk_takes_nothing_and_then_takes_again(rig, tmp_path):
    log = tmp_path / "run.mcap"
    log.write_bytes(b"y" * 50)
    one = rig(code=WRITER.format(str(log)), kind="disk_full", target="recorder", duration_s=0.2)

    def write():
        one.popen.stdin.write("\n")
        return one.popen.stdout.readline().strip()

    assert write() == "ok"
    one.act()
    assert write() == str(errno.EFBIG)
    time.sleep(0.25)
    one.act()
    assert write() == "ok"
    assert log.stat().st_size == 250


def test_a_router_is_taken_away_given_back_and_told_of_once_all_can_hear_it(rig, monkeypatch):
    monkeypatch.setattr("softloop.deploy.injector.BACK_S", 0.3)
    one, done = rig(kind="router_loss", target="", duration_s=0.2), []
    one.injector.router = SimpleNamespace(kill=lambda: done.append("kill"), start=lambda: done.append("start"))
    assert one.act() == []
    assert done == ["kill"]
    time.sleep(0.25)
    assert one.act(there=False) == []
    assert done == ["kill", "start"]
    time.sleep(0.35)
    assert one.act(there=False) == []  # it takes its time to come back
    assert one.act() == []
    time.sleep(0.35)
    assert one.act() == [(FAULTS["router_loss"], 1), (FAULTS["router_loss"], 0)]
    came, left = (event.stamp_ns for event in one.said)
    assert 0.2e9 <= left - came < 5e9
    assert one.act() == one.act()
