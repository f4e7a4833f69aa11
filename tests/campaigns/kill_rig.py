"""What the kill campaign works on: a sender, recorders in processes of their own, and what is left in their logs."""

import random
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from softloop.offline.log import open_log
from softloop.offline.log_repair import repair_log
from softloop.wire.channels import CYCLE, PRESSURE, TRUTH, VALVES, can_key, key
from softloop.wire.config import ZenohConfig
from softloop.wire.errors import SoftloopError
from softloop.wire.messages import message
from softloop.wire.session import Wire, open_router, open_wire
from tests.campaigns.recorder_node import BENCH

TICK_S = 0.005
START_S, END_S = 120.0, 20.0
LANES = [(key(BENCH, c), message(c.message), c.name) for c in (PRESSURE, VALVES, CYCLE, TRUTH)]
LANES += [(can_key(BENCH, "can0", 0x80), message("CanFrame"), ("can0", 0x80))]


class Sender:
    """A thread that publishes one message per lane and tick; `stamps[k]` is that of number k + 1."""

    def __init__(self, wire):
        self.stamps = []
        self._stop = threading.Event()
        self._puts = [wire.declare_publisher(full_key, realtime=False).put for full_key, _, _ in LANES]
        self._noise = random.Random(0)
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()

    def _send(self):
        while not self._stop.wait(TICK_S):
            self.stamps.append(time.monotonic_ns())
            head = {"seq": len(self.stamps), "stamp_ns": self.stamps[-1]}
            for put, (_, kind, _) in zip(self._puts, LANES, strict=True):
                payload = kind.pack(kind.make(**head))
                # Bytes that do not compress, as measured values are.
                put(payload[:28] + self._noise.randbytes(len(payload) - 28) if kind.name != "CanFrame" else payload)

    def close(self):
        self._stop.set()
        self._thread.join()


@dataclass
class Site:
    """A folder, a meeting point and a sender."""

    folder: Path
    endpoint: str
    wire: Wire
    sender: Sender

    def make_run_dir(self, name):
        run_dir = self.folder / name
        run_dir.mkdir()
        return run_dir


@contextmanager
def open_site():
    """A `Site`, and nothing of it after."""
    folder = Path(tempfile.mkdtemp(prefix="sl-kill-"))
    zenoh = ZenohConfig(mode="client", lease_ms=20_000, endpoint=f"unixsock-stream/{folder}/m.sock")
    try:
        with open_router(zenoh, BENCH), open_wire(zenoh, BENCH, "sender") as wire:
            sender = Sender(wire)
            try:
                yield Site(folder, zenoh.endpoint, wire, sender)
            finally:
                sender.close()
    finally:
        shutil.rmtree(folder)


@contextmanager
def recorder(site, run_dir, limit_bytes=0, within=()):
    """A recorder in a process of its own, once it is alive; killed at the end at the latest.

    Its run directory is there already. What it says stands in `said.txt` there. `within`: the command that starts it elsewhere.
    """
    name, said = run_dir.name, run_dir / "said.txt"
    command = [
        *within,
        sys.executable,
        "-m",
        "tests.campaigns.recorder_node",
        site.endpoint,
        str(run_dir),
        name,
        str(limit_bytes),
    ]
    with said.open("w") as stderr:
        child = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=stderr)  # stdin: its lifeline
    try:
        end = time.monotonic() + START_S
        while name not in site.wire.processes_alive():
            if time.monotonic() > end or child.poll() is not None:
                raise RuntimeError(f"the recorder did not start: {child.poll()} {said.read_text()}")
            time.sleep(0.02)
        yield child
    finally:
        child.kill()
        child.wait()
        child.stdin.close()


@contextmanager
def failing(outcome, what):
    """A step whose errors are failures of the campaign, which goes on."""
    try:
        yield
    except (AssertionError, RuntimeError, SoftloopError, subprocess.TimeoutExpired) as error:
        outcome.fail(f"{what}: {error}")


def recovered(run_dir):
    """What a repair makes of the run's log, and the messages in it by lane. Raises AssertionError when it is not whole."""
    made = repair_log(run_dir / "run.mcap", run_dir / "good.mcap")
    log = open_log(made.file)
    assert log.problems == [], log.problems
    return log, lanes_of(log)


def lanes_of(log):
    """The messages in a log by lane; None where a CAN identifier has none."""
    return {name: log.can.get(name) if isinstance(name, tuple) else log[name] for _, _, name in LANES}


def missing_between(lanes, stamps, from_ns, until_ns):
    """How many messages stamped in [from, until] are not in a log, over all lanes; and how many should be."""
    wanted = {k + 1 for k, stamp in enumerate(list(stamps)) if from_ns <= stamp <= until_ns}
    there = (set(() if records is None else records["seq"].tolist()) for records in lanes.values())
    return sum(len(wanted - numbers) for numbers in there), len(wanted) * len(LANES)


def ends_ns(lanes):
    """The stamp of the newest message of a log; 0 without any."""
    return max((int(records["stamp_ns"].max()) for records in lanes.values() if records is not None and len(records)), default=0)


def waited_s(pid):
    """For how long a process's main thread has waited for a processor since its start, s; 0 where the kernel does not say."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) * 1e-9
    except (OSError, ValueError, IndexError):
        return 0.0


def watched(pid, seconds):
    """Look at a process's main thread for so long: what it did at how many looks (its state, and the system call it was in)."""
    seen, end = Counter(), time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        time.sleep(min(left, 0.05))
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
            seen[f"{state} in call {Path(f'/proc/{pid}/syscall').read_text().split()[0]}"] += 1
        except OSError:  # the kernel does not say
            seen["unknown"] += 1
    return ", ".join(f"{count} times {what}" for what, count in seen.most_common(4))
