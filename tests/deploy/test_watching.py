"""`softloop top` and `softloop echo` as a person runs them, beside somebody who speaks on the bench."""

import json
import os
import subprocess
import sys
import time

import pytest
from tests.watch.benches import repeating, speaking, write_bench
from tests.wire.rendezvous import short_folder


def softloop(*arguments):
    command = [sys.executable, "-m", "softloop.deploy.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, stdin=subprocess.DEVNULL)


@pytest.fixture(scope="module")
def bench():
    """A bench on which a cycle record and a frame go by every 5 ms."""
    with short_folder() as folder:
        file = write_bench(folder, f"watched-{os.getpid()}")
        with speaking(file) as speaker:

            def turn(i):
                now_ns = time.monotonic_ns()
                speaker.say("cycle", seq=i + 1, stamp_ns=now_ns, woken_ns=now_ns + 50_000, angle_deg=42.5, phase=2)
                speaker.frame("can0", 0x80, seq=i + 1, dlc=8)

            with repeating(turn):
                yield file


def test_echo_prints_as_many_as_asked(bench):
    done = softloop("echo", "cycle.angle_deg,phase", bench, "-n", "3", "--json")
    assert done.returncode == 0, done.stderr
    assert [json.loads(line) for line in done.stdout.splitlines()] == [{"angle_deg": 42.5, "phase": 2}] * 3
    done = softloop("echo", "can/can0", bench, "-n", "1")
    assert done.stdout.startswith("can0/80 seq=")


def test_a_silent_channel_and_a_wrong_one_are_said(bench):
    done = softloop("echo", "truth", bench, "--timeout", "0.5")
    assert (done.returncode, done.stderr) == (4, "softloop: nothing on 'truth' for 0.5 s\n")
    done = softloop("echo", "cycle.speed", bench)
    assert done.returncode == 2
    assert "no field 'speed'" in done.stderr


def test_top_once_shows_rates_and_loads(bench):
    done = softloop("top", bench, "--once")
    assert done.returncode == 0, done.stderr
    assert "phase track" in " ".join(done.stdout.split())
    assert "can/can0/80" in " ".join(done.stdout.split())
    assert "tick lateness p50 0.05" in " ".join(done.stdout.split())


@pytest.mark.parametrize("command", [("top",), ("echo", "cycle")])
def test_a_bench_that_does_not_run_is_said(command):
    with short_folder() as folder:
        done = softloop(*command, write_bench(folder, "nobody"))
        assert done.returncode == 3
        assert done.stderr.startswith("softloop: nobody of bench 'nobody' is at ")
        assert done.stderr.count("\n") == 1
