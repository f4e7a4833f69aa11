"""Full disks for the kill campaign: a limit of the kernel on the size of the recorder's files, and a real, small file system.

The file system is a tmpfs in a mount namespace of its own, which a process holds whose input is a pipe of ours: whatever ends
the campaign, the mount goes with it. It needs root; where it cannot be, that part is left out, and counted as left out.
"""

import json
import os
import random
import resource
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from tests.campaigns.kill_rig import END_S, failing, missing_between, recorder, recovered

DISK_BYTES = 8 << 20
PAGE = 4096
FULL_S = 60.0  # the sender fills the room in a few seconds
LEFT_OUT = "real disks full: left out, mounting needs root"
MOUNT = 'mount -t tmpfs -o size="$2" softloop-full "$1" && echo mounted && exec cat'


class FileLimit:
    """No file of the recorder's grows beyond `room` bytes."""

    what, refusal, within = "file sizes limited", "File too large", ()

    def __init__(self, run_dir, room):
        self.seen, self.limit_bytes = run_dir, room

    def make_room(self, child):
        resource.prlimit(child.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))

    def close(self):
        pass


class SmallDisk:
    """A file system on `run_dir` with `room` bytes left beside a file that fills it."""

    what, refusal, limit_bytes = "real disks full", "No space left on device", 0

    def __init__(self, run_dir, room):
        command = ["unshare", "--mount", "sh", "-c", MOUNT, "sh", str(run_dir), str(DISK_BYTES)]
        self._holder = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        said = self._holder.stdout.readline().strip()
        if said != "mounted":
            self.close()
            raise RuntimeError(f"no small disk: {said}")
        self.seen = Path(f"/proc/{self._holder.pid}/root{run_dir}")
        self.within = ("nsenter", f"--mount=/proc/{self._holder.pid}/ns/mnt", f"--wd={Path.cwd()}", "--")
        self._filler = self.seen / "filler"
        self._filler.write_bytes(b"\1" * (DISK_BYTES - room // PAGE * PAGE))

    def make_room(self, _child):
        self._filler.unlink()

    def close(self):
        self._holder.stdin.close()
        self._holder.wait()
        self._holder.stdout.close()


def may_mount():
    """Whether this process may mount a file system in a namespace of its own; nothing is left of the trial."""
    if os.geteuid() != 0 or not (shutil.which("unshare") and shutil.which("nsenter")):
        return False
    with tempfile.TemporaryDirectory(prefix="sl-kill-") as folder:
        try:
            SmallDisk(Path(folder), PAGE).close()
        except RuntimeError:
            return False
    return True


def fill_all(outcome, site, full, seed):
    """So many full disks of either kind; of a campaign that goes on, those that are left."""
    fill(outcome, site, FileLimit, full, seed)
    if may_mount():
        fill(outcome, site, SmallDisk, full, seed)
    elif full:
        print(f"kill: {LEFT_OUT}", flush=True)
        outcome.counts[LEFT_OUT] = full


def fill(outcome, site, kind, full, seed):
    for number in range(sum(n for what, n in outcome.counts.items() if what.startswith(kind.what)), full):
        lifted = number % 2 == 0
        with failing(outcome, f"{kind.what}, number {number}"):
            fill_once(outcome, site, kind, random.Random(f"{seed} {kind.what} {number}"), lifted, f"{kind.__name__}{number}")
        outcome.count(f"{kind.what}, with room again" if lifted else f"{kind.what}, then killed")


def fill_once(outcome, site, kind, rng, lifted, name):
    """A disk that takes no more after so many bytes; then it has room again, or the recorder is killed."""
    room, run_dir = rng.randrange(40_000, 250_000), site.make_run_dir(name)
    disk = kind(run_dir, room)
    try:
        with recorder(site, run_dir, disk.limit_bytes, disk.within) as child:
            alive_ns = time.monotonic_ns() + 200_000_000
            await_full(run_dir / "said.txt", kind.refusal)
            time.sleep(rng.uniform(0.1, 2.0))
            ended_ns = end(child, disk, lifted)
        taken = shutil.copytree(disk.seen, site.folder / f"{name}-taken", ignore=shutil.ignore_patterns("filler"))
    finally:
        disk.close()
    judge(outcome, name, site, taken, (alive_ns, ended_ns), None if lifted else room)
    shutil.rmtree(taken)
    shutil.rmtree(run_dir)


def await_full(said, refusal):
    """Until the recorder says that its disk takes no more. Raises RuntimeError when it does not."""
    end_s = time.monotonic() + FULL_S
    while refusal not in said.read_text():
        if time.monotonic() > end_s:
            raise RuntimeError(f"its disk was not full: {said.read_text()!r}")
        time.sleep(0.02)


def end(child, disk, lifted):
    """Give the disk room and let the recorder end, or kill it; the time of that, ns."""
    if not lifted:
        child.kill()
        child.wait()
        return time.monotonic_ns()
    disk.make_room(child)
    time.sleep(0.5)
    ended_ns = time.monotonic_ns()
    child.terminate()
    child.wait(END_S)
    return ended_ns


def judge(outcome, name, site, taken, times_ns, killed_room):
    """With room again nothing is missing; of a killed one (`killed_room`) there is all that the disk took, without a gap."""
    _, lanes = recovered(taken)
    size = (taken / "run.mcap").stat().st_size
    if killed_room is not None:
        gaps = sum(int((np.diff(r["seq"].astype(int)) != 1).sum()) for r in lanes.values() if r is not None)
        if gaps or not killed_room - PAGE <= size <= killed_room:
            outcome.fail(f"{name}: {gaps} gaps in what a disk of {killed_room} bytes took ({size})")
        return
    missing, _ = missing_between(lanes, site.sender.stamps, times_ns[0], times_ns[1] - 200_000_000)
    if missing or not json.loads((taken / "recorder.json").read_text())["finished"]:
        outcome.fail(f"{name}: {missing} messages are missing though there was room again")
