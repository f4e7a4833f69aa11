"""The monitor: no false alarm on fault-free rigs, and every violation seen within its stated time.

    python -m tests.campaigns.monitor [--rigs 100] [--broken 20] [--seed 1] [--json FILE]

Each rig is drawn by its seed and driven without a fault, laws and trajectories in turn; the monitor's own judgement, at its
default limits, reads every cycle record of the run. Then violations are put into the same records at a random tick of the
trajectory, one kind at a time, and the ticks until each is seen are counted; a violation that is not seen within its stated
number of ticks, or by another name first, is a failure. Last, rigs whose plant breaks on the trajectory: who says so first,
the monitor or the gate.
"""

import random
import sys
from itertools import product

import numpy as np

from softloop.controller.config import ControllerConfig
from softloop.controller.records import PHASE_TRACK
from softloop.deploy.bench import monitor_process
from softloop.deploy.log_invariants import NAMES, rows_of, violations
from softloop.offline.closed_loop import simulate_run
from softloop.plant.config import FaultConfig, PlantConfig
from softloop.watch.config import MonitorConfig
from softloop.watch.invariants import (
    BOUND,
    CHATTER,
    COMMAND,
    ERROR,
    PARAMETERS,
    SECOND_TICKS,
    Memory,
    detection_ticks,
    judge,
)
from softloop.watch.monitor import limits_of, parameters_of
from softloop.wire.messages import constant
from tests.campaigns.outcome import Outcome, carried_out, options, steps

LAWS, TRAJECTORIES = ("arc", "smc", "pid", "arc_eso", "pid_eso"), ("t1", "t2")
CASES = list(product(TRAJECTORIES, LAWS))
CHARGE, EXHAUST = constant("ValveCommand", "MODE_CHARGE"), constant("ValveCommand", "MODE_EXHAUST")
BREAKS_S = 15.0  # of the plant's time: on the trajectory of both
BROKEN = [
    {"kind": "supply_loss", "size": 0.9},
    {"kind": "charge_stuck"},
    {"kind": "exhaust_stuck"},
    {"kind": "hose_burst", "size": 3.0},
]


def limits_for(controller):
    process = monitor_process(MonitorConfig(), controller)
    return limits_of(process, parameters_of(process))


def spoken_ticks(limits, cycles):
    """On how many ticks of a run the bound of Eq. 50 was asked for."""
    memory, spoken = Memory(), 0
    for row in rows_of(cycles):
        memory, _ = judge(limits, memory, row)
        spoken += memory.settled_ticks >= limits.settled_ticks
    return spoken


def settled_at(limits, cycles, rng):
    """A place at which the bound is asked for, and stays so for one tick; None when there is none."""
    memory, places = Memory(), []
    for place, row in enumerate(rows_of(cycles)):
        memory, _ = judge(limits, memory, row)
        if memory.settled_ticks >= limits.settled_ticks and row.phase == PHASE_TRACK:
            places.append(place)
    return rng.choice(places) if places else None


def put_parameters(limits, cycles, at, rng):
    place = rng.randrange(len(limits.theta))
    low, high = limits.theta[place]
    width = max(high - low, 1e-3 * abs(high))
    cycles["theta"][at:, place] = rng.choice((high + 0.01 * width, low - 0.01 * width, np.nan))


def put_command(limits, cycles, at, rng):
    name = rng.choice(("charge_current_ma", "exhaust_current_ma"))
    cycles[name][at:] = rng.choice((limits.current_max_ma + 0.1, -0.1, np.nan, np.inf))


def put_error(limits, cycles, at, rng):
    cycles["error_deg"][at:] = rng.choice((1.01, -1.01)) * limits.error_max_deg


def put_chatter(limits, cycles, at, rng):
    every = 2  # the shipped laws stay at least three ticks in charge or exhaust, and use that to the full
    cycles["mode"][at:] = np.where((np.arange(len(cycles) - at) // every) % 2, CHARGE, EXHAUST)


def put_bound(limits, cycles, at, rng):
    cycles["s1_deg_s"][at:] = np.sqrt(2.02 * limits.v2_max)


VIOLATIONS = {PARAMETERS: put_parameters, COMMAND: put_command, ERROR: put_error, CHATTER: put_chatter, BOUND: put_bound}


def violate(outcome, limits, cycles, number, rng, name):
    """Put one violation into a run's records and count the ticks until it is seen."""
    on_track = np.flatnonzero(cycles["phase"] == PHASE_TRACK)
    at = settled_at(limits, cycles, rng) if number == BOUND else int(rng.choice(on_track[:-400]))
    if at is None:
        outcome.count("runs on which Eq. 50 never speaks")
        return
    spoiled = cycles.copy()
    VIOLATIONS[number](limits, spoiled, at, rng)
    memory, stated = Memory(), detection_ticks(limits)[number]
    for place, row in enumerate(rows_of(spoiled)):
        memory, found = judge(limits, memory, row)
        if found:
            ticks = place - at + 1
            outcome.count(f"{NAMES[number]}: violations seen")
            key = f"{NAMES[number]}: most ticks until seen (stated {stated})"
            outcome.keep_largest(key, ticks)
            if not 1 <= ticks <= stated or number not in {verdict.invariant for verdict in found}:
                outcome.fail(f"{name}: {NAMES[number]} put in at {at} was seen after {ticks} ticks as {found}")
            return
    outcome.fail(f"{name}: {NAMES[number]} put in at {at} was not seen")


def fault_free(outcome, seed, law, trajectory, rng):
    controller = ControllerConfig(law=law, trajectory=trajectory)
    run, limits, name = simulate_run(controller, PlantConfig(seed=seed)), limits_for(controller), f"{law} {trajectory} rig {seed}"
    outcome.count("fault-free rigs")
    outcome.count("ticks judged", len(run.cycles))
    switches = np.convolve(np.diff(run.cycles["mode"].astype(int)) != 0, np.ones(SECOND_TICKS, int))
    outcome.keep_largest(f"mode switches within one second, most (limit {limits.switches_max:g})", int(switches.max()))
    outcome.count("ticks on which Eq. 50 speaks", spoken_ticks(limits, run.cycles) if np.isfinite(limits.v2_max) else 0)
    outcome.count("false alarms", 0)
    if run.fault or not run.completed:
        outcome.fail(f"{name}: not fault-free: {run.fault}")
        return
    for alarm in violations(limits, run.cycles):
        outcome.count("false alarms")
        outcome.fail(f"{name}: false alarm: {alarm}")
    for number in VIOLATIONS:
        if number != BOUND or np.isfinite(limits.v2_max):
            violate(outcome, limits, run.cycles, number, rng, name)


def broken(outcome, seed, law, kind):
    """A rig that breaks on its trajectory, and who says so first."""
    controller = ControllerConfig(law=law, trajectory="t2")
    plant = PlantConfig(seed=seed, faults=(FaultConfig(on_s=BREAKS_S, **kind),))
    run, limits = simulate_run(controller, plant), limits_for(controller)
    first = next(iter(violations(limits, run.cycles)), None)
    what = kind["kind"]
    outcome.count(f"broken rigs, {what}")
    if first is not None:
        outcome.count(f"broken rigs, {what}: seen by the monitor ({first['invariant']})")
    elif run.fault:
        outcome.count(f"broken rigs, {what}: seen by the gate ({run.fault})")
    else:
        outcome.count(f"broken rigs, {what}: driven on within all limits")


def campaign(rigs, broken_rigs, seed, outcome=None):
    """Run it; returns the outcome."""
    outcome, rng = outcome or Outcome("monitor"), random.Random(seed)
    for number in steps(range(rigs), "fault-free rigs"):
        trajectory, law = CASES[number % len(CASES)]
        fault_free(outcome, seed + number, law, trajectory, rng)
    for number in steps(range(broken_rigs), "broken rigs"):
        broken(outcome, seed + number, LAWS[number % len(LAWS)], BROKEN[number % len(BROKEN)])
    return outcome


def main():
    given = options(__doc__, rigs=100, broken=20).parse_args()
    return carried_out("monitor", given, lambda outcome: campaign(given.rigs, given.broken, given.seed, outcome))


if __name__ == "__main__":
    sys.exit(main())
