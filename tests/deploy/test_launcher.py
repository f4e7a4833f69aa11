import json
import os
import shutil
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest

from softloop.deploy.bench import load_bench
from softloop.deploy.children import Children
from softloop.deploy.launcher import Launch
from softloop.deploy.live import PlainView
from softloop.deploy.node import processes_of
from softloop.deploy.router import launcher_wire
from softloop.deploy.run_dir import bench_lock, keep_bench
from softloop.wire.errors import EXIT_INTERRUPTED, EXIT_LOST, EXIT_NEGATIVE, EXIT_OK, Unavailable
from softloop.wire.session import Wire, open_router, open_wire
from softloop.wire.shell import Stop

TOY = (sys.executable, str(Path(__file__).with_name("toy_node.py")))
BENCH = """
name = "toy"
[zenoh]
endpoint = "unixsock-stream/{run_dir}/m.sock"
[host]
realtime_priority = 0
[can.can0]
[valves]
can = "can0"
[pressures]
can = "can0"
[inclinometer]
port = "/dev/null"
[controller]
"""
LIMITS = {"ready_timeout_s": 20.0, "arm_timeout_s": 3.0, "stop_timeout_s": 1.0, "settle_s": 0.0}


@pytest.fixture
def short_dir():
    path = Path(tempfile.mkdtemp(prefix="sl-"))
    yield path
    shutil.rmtree(path)


class Said(PlainView):
    def __init__(self):
        super().__init__(1.0)
        self.lines = []

    def say(self, line):
        self.lines.append(line)


def wait_for(condition, timeout_s=10.0):
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.01)


def launch(run_dir, wrong, stop=None, more="", **changes):
    """Run the toy bench; returns how it ended, what was said and the children."""
    file = run_dir / "toy.toml"
    limits = LIMITS | changes
    file.write_text(BENCH + more + "[run]\n" + "".join(f"{key} = {value}\n" for key, value in limits.items()))
    (run_dir / "toy.json").write_text(json.dumps(wrong))
    bench = load_bench(file, run_dir)
    keep_bench(run_dir, bench)
    view, children = Said(), Children(TOY)
    with launcher_wire(bench) as wire:
        outcome = Launch(bench, run_dir, wire, view, Stop() if stop is None else stop, children).run()
    assert all(child.exit_code() is not None for child in children.all.values())
    assert sorted(p.name for p in run_dir.iterdir() if ".sock" in p.name) == []
    return outcome, view.lines, children


def test_a_run_ends_when_the_controller_is_done(short_dir):
    outcome, lines, children = launch(short_dir, {})
    assert outcome.code == EXIT_OK, outcome.text
    assert any(line.startswith("running, ") and "gate" in line for line in lines)
    assert [c.exit_code() for c in children.all.values()] == [0, 0, 0, 0]
    assert not any(c.killed for c in children.all.values())


def test_a_run_ends_after_the_asked_time(short_dir):
    outcome, _, _ = launch(short_dir, {"controller": "endless"}, duration_s=0.7)
    assert (outcome.code, outcome.text) == (EXIT_OK, "ended after 0.7 s as asked")


def test_a_process_that_fails_at_the_start_gives_its_own_code_and_word(short_dir):
    outcome, _, _ = launch(short_dir, {"pressures": "dies"})
    assert outcome.code == 3
    assert outcome.text == "process 'pressures' ended with code 3: [pressures] the cable is out"


def test_a_process_that_is_never_alive_is_named(short_dir):
    outcome, _, _ = launch(short_dir, {"pressures": "mute"}, ready_timeout_s=4.0)
    assert outcome.code == EXIT_LOST
    assert outcome.text.startswith("not alive after 4 s: pressures; see the logs in ")


@pytest.mark.parametrize("name", ["controller", "pressures"])
def test_a_process_that_dies_while_running_is_lost_and_named(short_dir, name):
    outcome, _, _ = launch(short_dir, {"controller": "endless"} | {name: "dies_armed"})
    assert outcome.code == EXIT_LOST
    assert f"process '{name}' ended with code 7" in outcome.text
    assert (short_dir / "asked").read_text() == "stop", "a lost process is a FAULT of the gate"


def test_a_gate_that_froze_shortly_before_the_end_is_lost(short_dir):
    outcome, _, _ = launch(short_dir, {"valves": "hangs_armed"})
    assert outcome.code == EXIT_LOST, outcome.text


def test_a_recorder_that_dies_is_started_again_and_the_run_goes_on(short_dir):
    wrong = {"controller": "endless", "recorder": "dies_once"}
    outcome, lines, children = launch(short_dir, wrong, more="[recorder]\n", duration_s=6.0)
    assert (outcome.code, outcome.text) == (EXIT_OK, "ended after 6 s as asked")
    assert "process 'recorder' ended with code 7" in "\n".join(lines)
    assert "process 'recorder' is back" in lines
    events = [line for line in lines if line.startswith("launcher: recorder")]
    assert events[0] == "launcher: recorder was lost"
    assert events[1].startswith("launcher: recorder is back after ")
    assert children.all["recorder"].exit_code() == 0


def test_a_recorder_that_cannot_start_ends_the_run(short_dir):
    outcome, _, _ = launch(short_dir, {"recorder": "dies"}, more="[recorder]\n")
    assert outcome.code == 3
    assert "the cable is out" in outcome.text


@pytest.mark.parametrize("order", [reversed, lambda names: names[2:] + names[:2]])
def test_the_order_of_starting_does_not_matter(short_dir, monkeypatch, order):
    monkeypatch.setattr("softloop.deploy.launcher.processes_of", lambda bench: tuple(order(processes_of(bench))))
    outcome, _, _ = launch(short_dir, {}, more="[recorder]\n")
    assert outcome.code == EXIT_OK, outcome.text


def test_a_gate_fault_ends_the_run_with_its_reason(short_dir):
    outcome, _, _ = launch(short_dir, {"valves": "faults"})
    assert (outcome.code, outcome.text) == (EXIT_NEGATIVE, "the gate went to FAULT: sensor stale")


def test_a_frozen_gate_is_noticed_and_killed(short_dir):
    outcome, lines, children = launch(short_dir, {"valves": "hangs_armed", "controller": "endless"}, vent_timeout_s=0.3)
    assert outcome.code == EXIT_LOST
    assert "'valves' is silent" in outcome.text
    assert "the chamber was not vented in time" in outcome.text
    assert children.all["valves"].killed
    assert any("'valves' did not end in 1 s and was killed" in line for line in lines)


def test_a_deaf_process_is_killed_and_its_socket_removed(short_dir):
    outcome, _, children = launch(short_dir, {"pressures": "deaf"})
    assert outcome.code == EXIT_OK
    assert [name for name, child in children.all.items() if child.killed] == ["pressures"]


def test_an_interrupt_disarms_and_stops(short_dir):
    stop, asked = Stop(), short_dir / "asked"

    def interrupt():
        wait_for(lambda: asked.exists() and asked.read_text() == "arm", 30.0)
        stop.set("SIGINT")

    person = threading.Thread(target=interrupt)
    person.start()
    outcome, _, _ = launch(short_dir, {"controller": "endless"}, stop=stop)
    person.join()
    assert outcome.code == EXIT_INTERRUPTED
    assert outcome.text.startswith("interrupted (SIGINT)")


def test_two_launchers_of_one_bench_are_refused():
    name = f"t{os.getpid()}"
    said = f"bench '{name}' is running already .launcher process {os.getpid()}"
    with bench_lock(name), pytest.raises(Unavailable, match=said), bench_lock(name):
        pass
    with bench_lock(name):
        pass


def test_a_shared_meeting_point_must_be_there_and_know_nobody_of_the_bench(short_dir):
    file = short_dir / "toy.toml"
    file.write_text(BENCH + "[run]\nshared_router = true\n")
    bench = load_bench(file, short_dir)
    with pytest.raises(Unavailable, match="no router at "), launcher_wire(bench):
        pass
    with open_router(bench.zenoh, bench.name) as session:
        meeting = Wire(session, bench.name, "router")
        with open_wire(bench.zenoh, bench.name, "plant") as plant:
            plant.declare_alive()
            wait_for(lambda: meeting.processes_alive() == {"plant"})
            with pytest.raises(Unavailable, match=r"bench 'toy' is running already at .*m\.sock: plant"), launcher_wire(bench):
                pass
        wait_for(lambda: not meeting.processes_alive())
        with launcher_wire(bench) as wire:
            wait_for(lambda: wire.processes_alive() == {"launcher"})
