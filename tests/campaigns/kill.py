"""Logs survive: the recorder killed at random instants, logs cut at random bytes, and a disk that is full.

    python -m tests.campaigns.kill [--kills 200] [--cuts 2000] [--full 20] [--seed 1] [--json FILE]

A sender publishes the messages of a bench in a run's proportions, stamped when they are sent. After a SIGKILL every message that
was sent more than a second before must be in what `softloop log repair` makes of the file. Of a cut file every chunk before the
cut must be recovered, and no chunk may span a second. The disk is full by a limit of the kernel on the size of the recorder's
files; it is lifted again, and nothing may be missing, or the recorder is killed, and all that the disk took must be there.
"""

import json
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np

from softloop.offline.log import open_log
from softloop.offline.log_check import check_log
from softloop.offline.log_repair import repair_log
from softloop.offline.mcap_walk import RECORD, FileRecords
from softloop.wire.channels import CYCLE, PRESSURE, TRUTH, VALVES, can_key, key
from softloop.wire.config import ZenohConfig
from softloop.wire.messages import message
from softloop.wire.session import open_router, open_wire
from tests.campaigns.outcome import Outcome, options, steps
from tests.campaigns.recorder_node import BENCH

LOST_NS = 1_000_000_000  # what a killed recorder may cost
TICK_S = 0.005
START_S = 120.0
KILLS_PER_RIG = 40
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


@contextmanager
def rig():
    """A meeting point and a sender; gives (folder, endpoint, wire, sender)."""
    folder = Path(tempfile.mkdtemp(prefix="sl-kill-"))
    zenoh = ZenohConfig(mode="client", lease_ms=20_000, endpoint=f"unixsock-stream/{folder}/m.sock")
    try:
        with open_router(zenoh, BENCH), open_wire(zenoh, BENCH, "sender") as wire:
            sender = Sender(wire)
            try:
                yield folder, zenoh.endpoint, wire, sender
            finally:
                sender.close()
    finally:
        shutil.rmtree(folder)


@contextmanager
def recorder(endpoint, run_dir, wire, name, limit_bytes=0):
    """A recorder in a process of its own, once it is alive; killed at the end at the latest."""
    run_dir.mkdir()
    command = [sys.executable, "-m", "tests.campaigns.recorder_node", endpoint, str(run_dir), name, str(limit_bytes)]
    with (run_dir / "said.txt").open("w") as said:
        child = subprocess.Popen(command, stderr=said)
    try:
        end = time.monotonic() + START_S
        while name not in wire.processes_alive():
            if time.monotonic() > end or child.poll() is not None:
                raise RuntimeError(f"the recorder did not start: {child.poll()} {(run_dir / 'said.txt').read_text()}")
            time.sleep(0.02)
        yield child
    finally:
        child.kill()
        child.wait()


def recovered(run_dir):
    """What a repair makes of the run's log, and the numbers in it by lane. Raises AssertionError when it is not whole."""
    made = repair_log(run_dir / "run.mcap", run_dir / "good.mcap")
    log = open_log(made.file)
    assert log.problems == [], log.problems
    return log, {name: (log.can.get(name) if isinstance(name, tuple) else log[name]) for _, _, name in LANES}


def missing_before(lanes, stamps, from_ns, until_ns):
    """How many messages stamped in [from, until] are not in a log, over all lanes."""
    wanted = [k + 1 for k, stamp in enumerate(list(stamps)) if from_ns <= stamp <= until_ns]
    return sum(len(set(wanted) - set(() if records is None else records["seq"].tolist())) for records in lanes.values()), len(
        wanted
    )


def kill_once(outcome, rng, folder, endpoint, wire, sender, number):
    run_dir = folder / f"kill{number}"
    with recorder(endpoint, run_dir, wire, f"recorder{number}") as child:
        alive_ns = time.monotonic_ns() + 200_000_000
        time.sleep(rng.uniform(0.0, 3.5))
        killed_ns = time.monotonic_ns()
        child.send_signal(signal.SIGKILL)
        child.wait()
    _, lanes = recovered(run_dir)
    missing, wanted = missing_before(lanes, sender.stamps, alive_ns, killed_ns - LOST_NS)
    outcome.count("recorders killed")
    outcome.count("messages that had to be there after a kill", wanted * len(LANES))
    if missing:
        outcome.fail(f"kill {number}, {(killed_ns - alive_ns) / 1e9:.2f} s after its start: {missing} messages are missing")
    shutil.rmtree(run_dir)


def finished_log(folder, endpoint, wire, seconds=6.0):
    """A log that its recorder ended itself."""
    run_dir = folder / "whole"
    with recorder(endpoint, run_dir, wire, "recorder-whole") as child:
        time.sleep(seconds)
        child.terminate()
        child.wait(20)
    return run_dir / "run.mcap"


def chunks_of(file):
    """The bytes of a whole log; and for each chunk, where it ends and the numbers by lane that stand in the file so far."""
    content = file.read_bytes()
    ends = [at + RECORD.size + len(body) for opcode, at, body in FileRecords(memoryview(content)) if opcode == 6]
    found = []
    for end in ends:
        part = file.with_name("part.mcap")
        part.write_bytes(content[:end])
        lanes = numbers_of(open_log(part))
        found.append((end, lanes))
    return content, found


def numbers_of(log):
    """The numbers in a log by lane, of the lanes that have any."""
    lanes = {name: log.can.get(name) if isinstance(name, tuple) else log[name] for _, _, name in LANES}
    return {name: records["seq"] for name, records in lanes.items() if records is not None and len(records)}


def cut_all(outcome, rng, file, cuts):
    content, chunks = chunks_of(file)
    for (_, before), (_, after) in pairwise(chunks):
        ticks = max(len(after[name]) - len(before.get(name, ())) for name in after)
        assert ticks * TICK_S < 1.0, "a chunk spans more than a second"
    run_dir = file.parent / "cut"
    for number in steps(range(cuts), "cuts"):
        at = rng.randrange(len(content) // 50, len(content))
        shutil.rmtree(run_dir, ignore_errors=True)
        run_dir.mkdir()
        (run_dir / "run.mcap").write_bytes(content[:at])
        log, lanes = recovered(run_dir)
        wanted = next((numbers for end, numbers in reversed(chunks) if end <= at), {})
        outcome.count("files cut")
        for name, numbers in wanted.items():
            if not np.array_equal(lanes[name]["seq"][: len(numbers)], numbers):
                outcome.fail(f"cut {number} at byte {at}: {name} is not what stood before the cut")
        if wanted and not (log.attachments and check_log(log).missing == 0):
            outcome.fail(f"cut {number} at byte {at}: attachments or numbers are missing")


def fill_once(outcome, rng, folder, endpoint, wire, sender, number):
    """A disk that takes no more after so many bytes; half of them get room again."""
    run_dir, limit, lifted = folder / f"full{number}", rng.randrange(30_000, 250_000), number % 2 == 0
    with recorder(endpoint, run_dir, wire, f"full{number}", limit) as child:
        alive_ns = time.monotonic_ns() + 200_000_000
        time.sleep(rng.uniform(1.0, 3.0))
        if lifted:
            resource.prlimit(child.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            time.sleep(0.5)
            ended_ns = time.monotonic_ns()
            child.terminate()
            child.wait(20)
        else:
            child.kill()
            child.wait()
    size = (run_dir / "run.mcap").stat().st_size
    _, lanes = recovered(run_dir)
    outcome.count("disks full, with room again" if lifted else "disks full, then killed")
    if lifted:
        missing, _ = missing_before(lanes, sender.stamps, alive_ns, ended_ns - 200_000_000)
        if missing or not json.loads((run_dir / "recorder.json").read_text())["finished"]:
            outcome.fail(f"disk full {number}: {missing} messages are missing though there was room again")
    else:
        gaps = sum(int((np.diff(r["seq"].astype(int)) != 1).sum()) for r in lanes.values() if r is not None)
        if gaps or size > limit:
            outcome.fail(f"disk full {number}: {gaps} gaps in what a disk of {limit} bytes took ({size})")
    shutil.rmtree(run_dir)


def campaign(kills, cuts, full, seed):
    """Run it; returns the outcome."""
    outcome, rng = Outcome("kill"), random.Random(seed)
    for first in range(0, kills, KILLS_PER_RIG):
        with rig() as (folder, endpoint, wire, sender):
            for number in steps(range(first, min(kills, first + KILLS_PER_RIG)), "kills"):
                kill_once(outcome, rng, folder, endpoint, wire, sender, number)
    with rig() as (folder, endpoint, wire, sender):
        for number in steps(range(full), "full disks"):
            fill_once(outcome, rng, folder, endpoint, wire, sender, number)
        cut_all(outcome, rng, finished_log(folder, endpoint, wire), cuts)
    return outcome


def main():
    given = options(__doc__, kills=200, cuts=2000, full=20).parse_args()
    return campaign(given.kills, given.cuts, given.full, given.seed).finish(given.json)


if __name__ == "__main__":
    sys.exit(main())
