"""Two whole rigs at once on one machine and one router: neither knows of the other."""

import os
import signal
import subprocess
import sys
from contextlib import ExitStack, contextmanager

import pytest
from mcap.reader import make_reader

from softloop.deploy.bench import load_bench, shipped_benches
from softloop.deploy.same import differences_from_batch, trace_of
from softloop.offline.log import open_log
from softloop.wire.channels import ROOT
from tests.rig.lockstep_benches import eventful
from tests.rig.rigs import running
from tests.rig.test_whole_rig import ARMED, WIDE
from tests.wire.rendezvous import short_folder

pytestmark = pytest.mark.rig

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


def test_a_stop_of_one_rig_leaves_the_other_armed():
    with one_router() as (folder, table), ExitStack() as stack:
        rigs = both(stack, lambda name: f'base = "{SIM}"\n{WIDE}[run]\nduration_s = 60.0\nreport = false\n', folder, table)
        for rig in rigs.values():
            rig.wait_for_word(ARMED)
        command = [sys.executable, "-m", "softloop.deploy.cli", "request", str(rigs["east"].bench), "stop", "--timeout", "20"]
        environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder)}
        asked = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env=environment)
        assert asked.returncode == 0, asked.stdout + asked.stderr
        assert rigs["east"].finish() == 1
        assert "emergency stop" in rigs["east"].output
        assert rigs["west"].process.poll() is None
        rigs["west"].signal(signal.SIGINT)
        assert rigs["west"].finish() == 130
        assert "FAULT" not in rigs["west"].output, rigs["west"].output
        assert [rig.left_over() for rig in rigs.values()] == [[], []]


def test_the_same_bench_twice_is_refused_and_the_first_one_does_not_notice():
    with one_router() as (folder, table), ExitStack() as stack:
        text = f'base = "{SIM}"\n{WIDE}[run]\nshared_router = true\nduration_s = 60.0\nreport = false\n{table}'
        first = stack.enter_context(running(text, name="east", runtime=folder))
        first.wait_for_word(ARMED)
        second = stack.enter_context(running(text, name="east", runtime=folder))
        assert second.finish() == 3
        with short_folder() as elsewhere:  # another user's lock folder: the router knows the bench's processes all the same
            third = stack.enter_context(running(text, name="east", runtime=elsewhere))
            assert third.finish() == 3
            assert "is running already" in third.output
        first.signal(signal.SIGINT)
        assert first.finish() == 130
        assert "FAULT" not in first.output, first.output
