"""Logs survive: the recorder killed at random instants, logs cut at random bytes, and a disk that is full.

    python -m tests.campaigns.kill [--kills 200] [--cuts 2000] [--full 20] [--seed 1] [--json FILE] [--resume]

A sender publishes the messages of a bench in a run's proportions, stamped when they are sent. After a SIGKILL every message that
was sent more than a second before must be in what `softloop log repair` makes of the file. Of a cut file every chunk before the
cut must be recovered, and no chunk may span a second. The disk is full by a limit of the kernel on the size of the recorder's
files, or a small file system that is full (`full_disk.py`); then there is room again, and nothing may be missing, or the
recorder is killed, and all that the disk took must be there.
"""

import random
import shutil
import signal
import sys
import time
from itertools import pairwise

import numpy as np

from softloop.offline.log import open_log
from softloop.offline.log_check import check_log
from softloop.offline.mcap_walk import RECORD, FileRecords
from tests.campaigns.full_disk import fill_all
from tests.campaigns.kill_rig import (
    END_S,
    TICK_S,
    ends_ns,
    failing,
    lanes_of,
    missing_between,
    open_site,
    recorder,
    recovered,
    waited_s,
    watched,
)
from tests.campaigns.outcome import Outcome, carried_out, options, steps

LOST_NS = 1_000_000_000  # what a killed recorder may cost
KILLS_PER_SITE = 40
KILLED, CUT = "recorders killed", "files cut"


def kill_once(outcome, rng, site, number):
    run_dir, life_s = site.make_run_dir(f"kill{number}"), rng.uniform(0.0, 3.5)
    with recorder(site, run_dir) as child:
        alive_ns = time.monotonic_ns() + 200_000_000
        time.sleep(max(0.0, life_s - 1.0))
        waited_before_s = waited_s(child.pid)
        did = watched(child.pid, min(1.0, life_s))
        waiting_ms = 1e3 * (waited_s(child.pid) - waited_before_s)
        killed_ns = time.monotonic_ns()
        child.send_signal(signal.SIGKILL)
        child.wait()
    _, lanes = recovered(run_dir)
    missing, wanted = missing_between(lanes, site.sender.stamps, alive_ns, killed_ns - LOST_NS)
    outcome.count("messages that had to be there after a kill", wanted)
    lost_ms = (killed_ns - ends_ns(lanes)) * 1e-6
    if killed_ns - alive_ns > LOST_NS:
        outcome.keep_largest("ms from the last message in a log to the kill, at most", lost_ms)
    outcome.keep_largest("ms in its last second that a recorder waited for a processor, at most", waiting_ms)
    if missing:
        outcome.fail(
            f"kill {number}, {(killed_ns - alive_ns) / 1e9:.2f} s after its start: {missing} messages are missing; the log ends "
            f"{lost_ms:.0f} ms before the kill; in its last second the recorder waited {waiting_ms:.0f} ms for a processor; {did}"
        )
    shutil.rmtree(run_dir)


def finished_log(site, seconds=6.0):
    """A log that its recorder ended itself."""
    run_dir = site.make_run_dir("whole")
    with recorder(site, run_dir) as child:
        time.sleep(seconds)
        child.terminate()
        child.wait(END_S)
    return run_dir / "run.mcap"


def chunks_of(file):
    """The bytes of a whole log; and for each chunk, where it ends and the numbers by lane that stand in the file so far."""
    content = file.read_bytes()
    ends = [at + RECORD.size + len(body) for opcode, at, body in FileRecords(memoryview(content)) if opcode == 6]
    found = []
    for end in ends:
        part = file.with_name("part.mcap")
        part.write_bytes(content[:end])
        lanes = lanes_of(open_log(part))
        found.append((end, {name: records["seq"] for name, records in lanes.items() if records is not None and len(records)}))
    return content, found


def cut_all(outcome, site, cuts, seed):
    """Cuts of one log; of a campaign that goes on, those that are left."""
    done = outcome.counts.get(CUT, 0)
    if done >= cuts:
        return
    file, rng = finished_log(site), random.Random(f"{seed} cuts {done}")
    content, chunks = chunks_of(file)
    for (_, before), (_, after) in pairwise(chunks):
        ticks = max(len(after[name]) - len(before.get(name, ())) for name in after)
        assert ticks * TICK_S < 1.0, "a chunk spans more than a second"
    for _ in steps(range(done, cuts), "cuts"):
        at = rng.randrange(len(content) // 50, len(content))
        with failing(outcome, f"cut at byte {at} of {len(content)}"):
            cut_once(site.folder / "cut", content[:at], next((numbers for end, numbers in reversed(chunks) if end <= at), {}))
        outcome.count(CUT)


def cut_once(run_dir, content, wanted):
    """Recover what is left; `wanted`: the numbers by lane in it. Raises AssertionError when that is not all."""
    shutil.rmtree(run_dir, ignore_errors=True)
    run_dir.mkdir()
    (run_dir / "run.mcap").write_bytes(content)
    log, lanes = recovered(run_dir)
    for name, numbers in wanted.items():
        assert np.array_equal(lanes[name]["seq"][: len(numbers)], numbers), f"{name} is not what stood before the cut"
    if wanted:
        assert log.attachments, "attachments are missing"
        assert check_log(log).missing == 0, "numbers are missing"


def campaign(kills, cuts, full, seed, outcome=None):
    """Run it, from where the counts of `outcome` stand; returns the outcome."""
    outcome = outcome or Outcome("kill")
    with open_site() as site:
        cut_all(outcome, site, cuts, seed)
        fill_all(outcome, site, full, seed)
    for first in range(outcome.counts.get(KILLED, 0), kills, KILLS_PER_SITE):
        with open_site() as site:
            for number in steps(range(first, min(kills, first + KILLS_PER_SITE)), KILLED):
                with failing(outcome, f"kill {number}"):
                    kill_once(outcome, random.Random(f"{seed} kill {number}"), site, number)
                outcome.count(KILLED)
    return outcome


def main():
    given = options(__doc__, resumable=True, kills=200, cuts=2000, full=20).parse_args()
    return carried_out("kill", given, lambda outcome: campaign(given.kills, given.cuts, given.full, given.seed, outcome))


if __name__ == "__main__":
    sys.exit(main())
