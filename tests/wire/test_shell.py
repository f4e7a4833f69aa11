"""The process shell, in real processes: signals, the lifeline, faults, and a plain word on missing permissions."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from softloop.wire.shell import Stop
from tests.wire.rendezvous import short_folder

SCRIPT = """
import sys
from pathlib import Path
from softloop.wire.config import HostConfig, ZenohConfig
from softloop.wire.errors import BadConfig
from softloop.wire.shell import run_process
folder, body, lifeline = sys.argv[1], sys.argv[2], int(sys.argv[3])

def loop(context):
    context.enter_loop()
    print("running", flush=True)
    while not context.stop:
        context.stop.wait(0.05)
    print("stopped by", context.stop.reason, flush=True)

def fault(context):
    raise ZeroDivisionError("boom")

def refused(context):
    raise BadConfig("a wrong key")

sys.exit(run_process("proc", {"loop": loop, "fault": fault, "refused": refused}[body], bench="t",
    zenoh=ZenohConfig(endpoint=f"unixsock-stream/{folder}/m.sock"), host=HostConfig(), run_dir=Path(folder),
    lifeline_fd=lifeline if lifeline >= 0 else None))
"""


def start(folder, body, lifeline=-1):
    passed = (lifeline,) if lifeline >= 0 else ()
    command = [sys.executable, "-c", SCRIPT, str(folder), body, str(lifeline)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, pass_fds=passed)


def finish(process):
    try:
        return process.communicate(timeout=20)
    finally:
        if process.poll() is None:
            process.kill()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_loop_cleanly(number):
    with short_folder() as folder:
        process = start(folder, "loop")
        assert process.stdout.readline() == "running\n"
        process.send_signal(number)
        out, _ = finish(process)
        assert out == f"stopped by {number.name}\n"
        assert process.returncode == 0


def test_a_closed_lifeline_ends_the_loop():
    with short_folder() as folder:
        read_end, write_end = os.pipe()
        process = start(folder, "loop", read_end)
        os.close(read_end)
        assert process.stdout.readline() == "running\n"
        time.sleep(0.2)
        assert process.poll() is None
        os.close(write_end)
        out, _ = finish(process)
        assert out == "stopped by lifeline closed\n"
        assert process.returncode == 0


def test_errors_are_one_line_with_their_exit_code_and_faults_keep_their_trace():
    with short_folder() as folder:
        process = start(folder, "refused")
        _, err = finish(process)
        assert err.splitlines()[-1] == "[proc] a wrong key"
        assert process.returncode == 2
        process = start(folder, "fault")
        _, err = finish(process)
        assert "Traceback" not in err
        assert "ZeroDivisionError" in err.splitlines()[-1]
        assert process.returncode == 4
        assert "boom" in (folder / "proc.trace.txt").read_text()


AMID_A_WAIT = """
import random, signal, sys
from softloop.wire.shell import Stop
rng, stop = random.Random(1), Stop()
signal.signal(signal.SIGALRM, lambda *_: stop.set("alarm"))
for _ in range(int(sys.argv[1])):
    stop = Stop()
    signal.setitimer(signal.ITIMER_REAL, rng.uniform(1e-6, 2e-4))
    while not stop:
        stop.wait(0.0)
    assert stop.wait(60.0) and stop.wait(0.0) and stop.reason == "alarm"
print("every time")
"""


def test_a_signal_amid_a_wait_is_heard_every_time():
    """With a lock that both need, held for a moment in each wait (`threading.Event`), one of the first never ends."""
    done = subprocess.run([sys.executable, "-c", AMID_A_WAIT, "1000"], capture_output=True, text=True, timeout=60)
    assert done.stdout == "every time\n", done.stderr


def test_a_stop_wakes_all_who_wait_and_keeps_the_first_reason():
    stop, woken = Stop(), []
    assert not stop
    assert not stop.wait(-1.0)
    waiting = [threading.Thread(target=lambda: woken.append(stop.wait(20.0))) for _ in range(5)]
    for thread in waiting:
        thread.start()
    stop.set("first")
    stop.set("second")
    for thread in waiting:
        thread.join(20.0)
    assert (woken, stop.reason, bool(stop)) == ([True] * 5, "first", True)
