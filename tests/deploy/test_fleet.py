"""Launchers of several hosts, each in a thread of its own with stand-ins for its processes: who waits, who leads, who ends."""

import json
import shutil
import sys
import tempfile
import threading
import time
from pathlib import Path

import pytest

from softloop.deploy.bench import load_bench
from softloop.deploy.children import Children
from softloop.deploy.fleet import DRIFT, STEP, SURE, UNSURE, Fleet
from softloop.deploy.hosts import digest
from softloop.deploy.launcher import launch_class
from softloop.deploy.live import PlainView
from softloop.deploy.router import launcher_wire
from softloop.deploy.run_dir import keep_bench
from softloop.wire.channels import CLOCK
from softloop.wire.errors import EXIT_INTERRUPTED, EXIT_LOST, EXIT_OK, EXIT_USAGE, Unavailable
from softloop.wire.messages import message
from softloop.wire.session import open_wire
from softloop.wire.shell import Stop

TOY = (sys.executable, str(Path(__file__).with_name("toy_node.py")))
BENCH = """
name = "fleet"
[zenoh]
endpoint = "unixsock-stream/{folder}/m.sock"
mode = "{mode}"
[host]
realtime_priority = 0
[clock]
uncertainty_max_ms = 500.0
[hosts.bench]
[hosts.desk]
[hosts.log]
[can.can0]
[valves]
host = "bench"
[pressures]
host = "bench"
[inclinometer]
host = "bench"
port = "/dev/null"
[controller]
host = "desk"
[recorder]
host = "log"
[run]
ready_timeout_s = 30.0
hosts_wait_s = {wait_s}
settle_s = 0.0
stop_timeout_s = 3.0
vent_timeout_s = 1.0
"""


class Said(PlainView):
    def __init__(self):
        super().__init__(1.0)
        self.lines = []

    def say(self, line):
        self.lines.append(line)


class Host(threading.Thread):
    """`softloop run --host NAME` of the toy bench, without its command line."""

    def __init__(self, folder, name, wrong, text):
        super().__init__()
        self.name_, self.stop, self.view, self.children = name, Stop(), Said(), Children(TOY)
        self.run_dir = folder / name
        self.run_dir.mkdir()
        (self.run_dir / "toy.json").write_text(json.dumps(wrong))
        self.file = folder / f"{name}.toml"
        self.file.write_text(text)
        self.outcome = self.error = None

    def run(self):
        bench = load_bench(self.file)
        same = digest(bench)
        bench = load_bench(self.file, self.run_dir)
        keep_bench(self.run_dir, bench)
        try:
            with launcher_wire(bench, self.name_, self.stop, self.view.say) as wire:
                fleet = Fleet(bench, self.name_, wire, same)
                kind = launch_class(bench, fleet)
                self.outcome = kind(bench, self.run_dir, wire, self.view, self.stop, self.children, 0.0, fleet).run()
                fleet.close()
        except Unavailable as error:
            self.error = str(error)

    @property
    def said(self):
        return "\n".join(self.view.lines)


@pytest.fixture
def folder():
    path = Path(tempfile.mkdtemp(prefix="sl-"))
    yield path
    shutil.rmtree(path)


@pytest.fixture
def start(folder):
    """Starts a host; all are ended with the test."""
    started = []

    def start_host(name, wrong=None, mode="peer", wait_s=60.0, text=BENCH):
        filled = text.replace("{folder}", str(folder)).replace("{mode}", mode).replace("{wait_s}", str(wait_s))
        host = Host(folder, name, wrong or {}, filled)
        started.append(host)
        host.start()
        return host

    yield start_host
    for host in started:
        host.stop.set("the test is over")
    for host in started:
        host.join(60)


def finish(*hosts):
    for host in hosts:
        host.join(90)
        assert not host.is_alive(), host.said
        assert all(child.exit_code() is not None for child in host.children.all.values())
    return [host.outcome and host.outcome.code for host in hosts]


def wait_until(condition, *hosts, timeout_s=60.0):
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "\n---\n".join(host.said for host in hosts)
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("mode", "order"),
    [
        ("peer", ("desk", "log", "bench")),
        pytest.param("client", ("bench", "log", "desk"), marks=pytest.mark.long),
        pytest.param("peer", ("bench", "log", "desk"), marks=pytest.mark.long),
        pytest.param("client", ("desk", "log", "bench"), marks=pytest.mark.long),
    ],
)
def test_hosts_start_in_any_order_and_end_together(start, mode, order):
    hosts = {}
    for name in order:
        hosts[name] = start(name, mode=mode)
        wait_until(lambda name=name: "waiting for " in hosts[name].said or name == order[-1], *hosts.values())
    assert finish(*hosts.values()) == [EXIT_OK] * 3, "\n---\n".join(f"{h.outcome}\n{h.said}" for h in hosts.values())
    assert list(hosts["bench"].children.all) == ["valves", "pressures", "inclinometer"]
    assert list(hosts["desk"].children.all) == ["controller"]
    assert list(hosts["log"].children.all) == ["recorder"]
    assert hosts["bench"].outcome.text == "the run is over, says host 'desk'"
    assert not any(child.killed for host in hosts.values() for child in host.children.all.values())


def test_what_is_missing_is_said_and_ends_after_a_while(start):
    desk, log = start("desk", wait_s=10.0), start("log", wait_s=10.0)
    assert finish(desk, log) == [EXIT_LOST, EXIT_LOST]
    missing = "host 'bench' (valves, pressures, inclinometer), which is not started"
    assert f"waiting for {missing}" in desk.said
    assert missing in log.said
    assert f"not there after 10 s: {missing}" == desk.outcome.text
    assert log.outcome.text == "host 'desk' ended the run with code 4"


def test_without_the_host_that_leads_there_is_no_meeting_point(start):
    log = start("log", wait_s=4.0)
    finish(log)
    assert log.error.startswith("no router at unixsock-stream/")
    assert "waiting for the meeting point" in log.said


def test_a_process_lost_on_one_host_ends_all(start):
    hosts = [start("bench", {"pressures": "dies_armed"}), start("desk", {"controller": "endless"}), start("log")]
    assert finish(*hosts) == [EXIT_LOST] * 3
    bench, desk, log = hosts
    assert "process 'pressures' ended with code 7" in bench.outcome.text
    assert desk.outcome.text.startswith("host 'bench' lost process 'pressures'; it says there why")
    assert log.outcome.text == "host 'desk' ended the run with code 4"


def test_a_process_that_cannot_start_on_one_host_ends_all(start):
    hosts = [start("bench", {"pressures": "dies"}), start("desk"), start("log")]
    codes = finish(*hosts)
    assert codes[0] == 3
    assert all(codes), codes
    assert "the cable is out" in hosts[0].outcome.text


def test_an_interrupt_on_one_host_disarms_and_ends_all(start):
    hosts = [start("bench"), start("desk", {"controller": "endless"}), start("log")]
    wait_until(lambda: "running, " in hosts[1].said and hosts[1].view.lines[-1].startswith("running"), *hosts)
    hosts[2].stop.set("SIGINT")
    assert finish(*hosts) == [EXIT_INTERRUPTED] * 3
    assert hosts[1].outcome.text.startswith("host 'log' was interrupted")


@pytest.mark.long
def test_another_bench_file_is_refused(start):
    other = BENCH.replace("[valves]", "[valves]\nhold_ticks = 4")
    hosts = [start("bench", text=other), start("desk"), start("log")]
    codes = finish(*hosts)
    assert EXIT_USAGE in codes
    assert all(codes)
    assert "has another bench file, or another version of softloop" in "\n".join(h.outcome.text for h in hosts)


@pytest.mark.long
def test_a_clock_that_is_not_sure_enough_arms_nothing(start):
    strict = BENCH.replace("uncertainty_max_ms = 500.0", "uncertainty_max_ms = 0.001")
    hosts = [start(name, text=strict, wait_s=14.0) for name in ("bench", "desk", "log")]
    codes = finish(*hosts)
    assert all(codes)
    assert "the clock of host 'bench', known to " in hosts[1].said
    assert "ms ([clock] uncertainty_max_ms = 0.001)" in hosts[1].said
    assert "gate armed" not in hosts[1].said
    assert hosts[1].said.count("waiting for ") < 10


def test_a_gate_that_is_elsewhere_and_faults_ends_the_run_with_its_reason(start):
    hosts = [start("bench", {"valves": "faults"}), start("desk"), start("log")]
    assert finish(*hosts) == [1, 1, 1]
    assert hosts[1].outcome.text == "the gate went to FAULT: sensor stale"


def test_steps_drifts_and_doubts_of_a_clock_are_said_by_the_host_that_leads(folder):
    text = BENCH.replace("{folder}", str(folder)).replace("{mode}", "client").replace("{wait_s}", "1")
    (folder / "fleet.toml").write_text(text)
    bench, said, kind = load_bench(folder / "fleet.toml"), [], message("ClockOffset")
    with launcher_wire(bench, "desk") as wire, open_wire(bench.zenoh, bench.name, "other") as other:
        fleet = Fleet(bench, "desk", wire, 1, lambda *event: said.append(event))
        put, seq = other.publisher(CLOCK), 0
        for values in (
            {"uncertainty_ns": 10_000_000},
            {"uncertainty_ns": 600_000_000},
            {"uncertainty_ns": 10_000_000, "steps": 1, "step_ns": -3_000_000},
            {"uncertainty_ns": 10_000_000, "steps": 1, "drifts": 1, "drift_ppm": 250.0},
        ):
            before, end = len(said), time.monotonic() + 20.0
            while len(said) == before:  # what is put before the two are linked is lost; each is one event, however often said
                assert time.monotonic() < end, said
                seq += 1
                put(kind.pack(kind.make(seq=seq, host=0, **values)))
                time.sleep(0.02)
                fleet.look()
            if values["uncertainty_ns"] > 500_000_000:
                assert said[-1] == (UNSURE, 0, 600.0)
            while wire_has_more(fleet, said):
                pass
        put(b"nothing")
        fleet.look()
        fleet.close()
    assert said == [(SURE, 0, 10.0), (UNSURE, 0, 600.0), (STEP, 0, -3.0), (SURE, 0, 10.0), (DRIFT, 0, 250.0)]


def wire_has_more(fleet, said):
    """Words of the last kind that are under way make no event any more; wait until none comes."""
    before = len(said)
    time.sleep(0.1)
    fleet.look()
    return len(said) != before
