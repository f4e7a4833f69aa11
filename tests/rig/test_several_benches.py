"""Two benches at once on one machine and one router: neither knows of the other."""

import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager

import pytest
from mcap.reader import make_reader

from softloop.deploy.bench import load_bench, shipped_benches
from softloop.deploy.same import differences_from_batch, trace_of
from softloop.offline.log import open_log
from softloop.wire.channels import ROOT
from softloop.wire.errors import EXIT_ENVIRONMENT
from tests.rig.lockstep_benches import eventful
from tests.rig.rigs import LIMIT_S, running
from tests.wire.rendezvous import short_folder

pytestmark = pytest.mark.long

SIM = shipped_benches()["sim"]
NAMES = ("east", "west")


@contextmanager
def one_router():
    """A folder with a meeting point in it, held by `softloop router` as long as the block runs; gives its `[zenoh]` table."""
    with short_folder() as folder:
        table = f'[zenoh]\nendpoint = "unixsock-stream/{folder}/m.sock"\n'
        bench = folder / "router.toml"
        bench.write_text(f'name = "router"\n{table}')
        command = [sys.executable, "-m", "softloop.deploy.cli", "router", str(bench)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as router:
            try:
                assert "meeting point" in router.stdout.readline()
                yield folder, table
            finally:
                router.send_signal(signal.SIGINT)
                router.wait(30)


def topics_of(rig):
    """All topics of a rig's log."""
    with (rig.run_dir / "run.mcap").open("rb") as stream:
        return {channel.topic for channel in make_reader(stream).get_summary().channels.values()}


def both(stack, text_of, folder, table):
    """The two rigs, started at once, with sockets and locks in one folder."""
    rigs = {}
    for name in NAMES:
        text = text_of(name).replace("[run]\n", "[run]\nshared_router = true\n") + table
        rigs[name] = stack.enter_context(running(text, name=name, runtime=folder))
    return rigs


def test_each_of_two_rigs_leaves_what_it_leaves_alone_byte_for_byte():
    """At lockstep pace, where a run is the same however busy the machine is: one message of the other's would show."""
    seeds = dict(zip(NAMES, (5, 6), strict=True))
    with one_router() as (folder, table), ExitStack() as stack:
        rigs = both(stack, lambda name: eventful(SIM, seed=seeds[name]), folder, table)
        codes = {name: rig.finish() for name, rig in rigs.items()}
        assert codes == dict.fromkeys(NAMES, 1), [rig.output + rig.logs() for rig in rigs.values()]  # its driver hears no more
        for name, rig in rigs.items():
            log = open_log(rig.run_dir / "run.mcap")
            assert log.problems == []
            assert {topic.split("/")[2] for topic in topics_of(rig)} == {name}
            assert {topic.split("/")[1] for topic in topics_of(rig)} == {ROOT}
            trace = trace_of(load_bench(rig.run_dir / "bench.toml", rig.run_dir))
            assert [str(d) for d in differences_from_batch(log, trace)] == []
            assert len(log["cycle"]) == len(trace.cycles) > 500
            assert rig.left_over() == []


class Gates:
    """The gate of each of two benches on one router, alone, as `softloop node` runs it."""

    def __init__(self, folder, table, stack):
        self.folder, self.environment = folder, {**os.environ, "XDG_RUNTIME_DIR": str(folder)}
        for name in NAMES:
            (folder / name).mkdir()
            text = AT_REST.format(name=name, table=table)
            (folder / f"{name}.toml").write_text(text)
            arguments = ["node", "valves", str(folder / f"{name}.toml"), "--run-dir", str(folder / name)]
            process = stack.enter_context(
                subprocess.Popen([*PROGRAM, *arguments], env=self.environment, stderr=subprocess.DEVNULL)
            )
            stack.callback(process.kill)

    def softloop(self, *arguments):
        return subprocess.run(
            [*PROGRAM, *arguments], capture_output=True, text=True, timeout=LIMIT_S, check=False, env=self.environment
        )

    def ask(self, name, action):
        """`softloop request`, again while the gate is not heard yet; what it says."""
        end_s = time.monotonic() + LIMIT_S
        while True:
            asked = self.softloop("request", str(self.folder / f"{name}.toml"), action, "--timeout", "30")
            if asked.returncode != EXIT_ENVIRONMENT:
                assert asked.returncode == 0, asked.stdout + asked.stderr
                return asked.stdout.strip()
            assert time.monotonic() < end_s, asked.stderr


PROGRAM = (sys.executable, "-m", "softloop.deploy.cli")
AT_REST = (
    'name = "{name}"\n{table}[host]\nrealtime_priority = 0\n[run]\nshared_router = true\n'
    '[can.can0]\n[valves]\n[pressures]\n[inclinometer]\nport = "/dev/null"\n'
)


@pytest.fixture
def gates():
    with one_router() as (folder, table), ExitStack() as stack:
        yield Gates(folder, table, stack)


def test_a_stop_of_one_rig_does_not_reach_the_other(gates):
    assert {gates.ask(name, "disarm") for name in NAMES} == {"gate disarmed"}
    assert gates.ask("east", "stop") == "gate fault (emergency stop)"
    assert gates.ask("west", "disarm") == "gate disarmed"  # it is where it was, and hears what is meant for it
    assert gates.ask("west", "stop") == "gate fault (emergency stop)"


def test_the_router_knows_a_bench_that_runs_already(gates):
    assert {gates.ask(name, "disarm") for name in NAMES} == {"gate disarmed"}
    refused = gates.softloop("run", str(gates.folder / "east.toml"), "--run-dir", str(gates.folder / "again"))
    assert refused.returncode == EXIT_ENVIRONMENT
    assert "bench 'east' is running already at " in refused.stderr
    assert gates.ask("east", "disarm") == "gate disarmed"
