"""A rig over TLS beside those who should not be there: what the flood costs the 5 ms loop.

    python -m tests.campaigns.flood [--seconds 20] [--rounds 3] [--mode client] [--json FILE]

Rigs run armed for so long, one after the other in turn: alone, and beside four attackers at once (no certificate, one of another
authority, one that expired, and a sensor's, which is good and has no right). Each tries to move a valve, to read, to arm and to
flood, without pause. A failure is a rig that does not stay armed, a message in its log that is not its own, or one that an
attacker heard. Ticks that the controller left out are counted for both and not judged: on a busy machine some are in either.
"""

import shutil
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from softloop.offline.metrics import while_armed
from softloop.offline.run_log import open_run
from softloop.wire.messages import constant
from tests.campaigns.outcome import Outcome, carried_out, options, steps
from tests.rig.rigs import running
from tests.rig.test_whole_rig import WIDE
from tests.security.attackers import ORIGIN, Attacker
from tests.security.secured import Secured, zenoh_table

NAME = "sec"
ARMED, FAULT = constant("ValveStatus", "GATE_ARMED"), constant("ValveStatus", "GATE_FAULT")
WHO = (("no certificate", "keys", ""), ("a wrong one", "wrong", "controller"), ("an expired one", "expired", "controller"))
WHO += (("one without the right", "keys", "pressures"),)


def bench_text(folder, mode):
    """A rig over TLS that tracks until it is ended, with budgets that a busy machine keeps."""
    times = np.arange(0.0, 600.0, 0.05)
    np.savetxt(folder / "wave.csv", np.c_[times, 60 + 10 * np.sin(times / 3)], delimiter=",", header="t_s,angle_deg")
    run = "[run]\nreport = false\nready_timeout_s = 90.0\n[monitor]\n"
    table = f'[controller]\ntrajectory = "{folder}/wave.csv"\napproach_s = 2.0\n{run}'
    return f'base = "{folder}/wide.toml"\n{zenoh_table(folder, mode)}{table}'


class Site:
    """A bench with its keys, and the keys of its attackers, in a folder that goes with it."""

    def __init__(self, mode):
        self.mode = mode  # of the rig, and of the attackers: in mode peer they reach every process
        from softloop.deploy.bench import shipped_benches  # noqa: PLC0415

        self.folder = Path(tempfile.mkdtemp(prefix="sl-flood-"))
        (self.folder / "wide.toml").write_text(f'base = "{shipped_benches()["sim"]}"\n{WIDE}')
        self.text = bench_text(self.folder, mode)
        file = self.folder / "b.toml"
        file.write_text(f'name = "{NAME}"\n{self.text}')
        self.at = Secured(self.folder, file)

    def close(self):
        shutil.rmtree(self.folder, ignore_errors=True)


def one_run(site, seconds, outcome, *, attacked):
    """One rig, armed for `seconds`; counts what it did into `outcome`."""
    under = "under attack" if attacked else "alone"
    who = WHO if attacked else ()
    with ExitStack() as stack:
        attackers = [Attacker(site.at.file, site.folder / folder, name, site.mode, seconds) for _, folder, name in who]
        for attacker in attackers:
            stack.callback(attacker.close)
        rig = stack.enter_context(running(site.text, name=NAME, arguments=("--duration", str(seconds))))
        rig.wait_for_word("gate armed")
        for attacker in attackers:
            attacker.begin()
        code = rig.finish()
        for (name, _, _), attacker in zip(who, attackers, strict=True):
            count_attacker(outcome, name, attacker.done())
        if code != 0:
            outcome.fail(f"{under}: the rig ended with {code}: {rig.output.strip().splitlines()[-2:]}")
        if rig.left_over():
            outcome.fail(f"{under}: left over: {rig.left_over()}")
        count_rig(outcome, under, open_run(rig.run_dir))


def count_attacker(outcome, who, done):
    outcome.count(f"messages put by {who}", done["puts"])
    outcome.count(f"links tried by {who}", done["sessions"] + done["refused"])
    outcome.count(f"links had by {who}", done["sessions"])
    if done["heard"]:
        outcome.fail(f"{who}: heard {done['heard']} messages of the rig: {done['keys']}")


def count_rig(outcome, under, log):
    """What the controller and the gate made of their ticks, and whether all that is in the log is the rig's own."""
    cycles, valves = while_armed(log, log["cycle"]), log["valves"]
    late_us = (cycles["woken_ns"] - cycles["stamp_ns"]) * 1e-3
    outcome.count(f"ticks {under}", len(cycles))
    outcome.count(f"ticks left out {under}", int(cycles["skipped"].sum()))
    outcome.count(f"commands that the gate missed {under}", missed_commands(valves))
    for percent in (50, 99, 99.9, 100):
        outcome.keep_largest(f"us late {under}, {percent:g} % at most, the worst of the runs", np.percentile(late_us, percent))
    if FAULT in valves["gate"]:
        outcome.fail(f"{under}: the gate went to FAULT")
    for name in ("request", "arm"):
        if (log[name]["origin"] == ORIGIN).any():
            outcome.fail(f"{under}: an attacker's {name} is in the log")
    if any((frames["node"] == ORIGIN).any() for frames in log.can.values()):
        outcome.fail(f"{under}: an attacker's frame is in the log")
    if (np.diff(log["command"]["seq"].astype(np.int64)) < 1).any():
        outcome.fail(f"{under}: commands that are not the controller's are in the log")


def missed_commands(valves):
    """Commands between the first and the last answered while armed that no valve frame answers."""
    answered = valves["command_seq"][(valves["gate"] == ARMED) & (valves["command_seq"] > 0)].astype(np.int64)
    return int(np.maximum(np.diff(answered) - 1, 0).sum()) if len(answered) else 0


def campaign(seconds, rounds, mode, outcome=None):
    outcome = outcome or Outcome("flood")
    site = Site(mode)
    try:
        for _ in steps(range(rounds), "rigs under attack"):
            for attacked in (False, True):
                one_run(site, seconds, outcome, attacked=attacked)
                outcome.count("rigs")
                time.sleep(0.5)
    finally:
        site.close()
    return outcome


if __name__ == "__main__":
    given = options(__doc__, seconds=20.0, rounds=3, mode="client").parse_args()
    sys.exit(carried_out("flood", given, lambda outcome: campaign(given.seconds, given.rounds, given.mode, outcome)))
