"""Mutants of the safety gate and of the valve driver's watchdog: each must fail a test, or be justified in writing.

    python -m tests.campaigns.mutate [--one-in 1] [--module gate] [--seed 1] [--json FILE] [--resume]

Kernels run as plain Python here. Each mutant lives in a process of its own, forked from one in which pytest has loaded and
collected everything; there it takes the place of the module's functions, and the tests run until the first one fails. One that
does not end in time counts as killed too, and is counted apart.
"""

import ast
import importlib
import importlib.util
import os
import random
import resource
import signal
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

os.environ["NUMBA_DISABLE_JIT"] = "1"  # before numba is loaded

import hypothesis
import pytest
from _pytest.main import pytest_runtestloop as run_tests

from tests.campaigns.justified import JUSTIFIED
from tests.campaigns.mutants import mutants_of
from tests.campaigns.outcome import Outcome, carried_out, options, steps

LIMIT_S = 60  # of processor time
KILLED, SURVIVED = 1, 0


@dataclass(frozen=True)
class Target:
    """A module under mutation, the functions in question, and the tests that must notice."""

    module: str
    functions: tuple
    tests: tuple


_QUICK = "not compiled_and_plain and not ten_minutes"  # the one starts processes, the other needs the compiler's speed
TARGETS = {
    "gate": Target(
        "softloop.devices.gate",
        (
            "command_reason", "take_command", "driver_now", "condition", "arm_is_new", "change_state", "vent_output", "limited",
            "gate_step", "_next_states", "gate_config",
        ),
        (*(f"tests/devices/test_gate{part}.py" for part in ("_edges", "", "_sequences")), "-k", _QUICK),
    ),
    "watchdog": Target(
        "softloop.plant.electrical",
        ("accept_command", "_frame_due_ns", "next_event_ns", "_drive", "_apply_frame", "_watchdog"),
        ("tests/plant/test_watchdog.py",),
    ),
}  # fmt: skip


def source_of(target):
    return Path(importlib.util.find_spec(target.module).origin).read_text()


class Judge:
    """A pytest plugin that, instead of running the collected tests once, runs them against each mutant."""

    def __init__(self, target, judge_all):
        self._target, self._judge_all = target, judge_all
        self.reached = False

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session):
        self.reached = not session.testsfailed and bool(session.items)
        if self.reached:
            self._judge_all(lambda tree: judge(self._target, tree, session))
        return True


def judge(target, tree, session):
    """In a process of its own: load the mutant and run the tests. Returns KILLED, SURVIVED, or None for no end in time."""
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_S, LIMIT_S))
        code = KILLED
        try:
            code = _be_mutant(target, tree, session)
        finally:
            os._exit(code)
    try:
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    except KeyboardInterrupt:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        raise
    if code == -signal.SIGXCPU:
        return None
    return SURVIVED if code == SURVIVED else KILLED


def _be_mutant(target, tree, session):
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    # Into the module that is loaded: its functions find each other, and the tests find them, by the module's names.
    module = importlib.import_module(target.module)
    exec(compile(tree, module.__file__, "exec"), module.__dict__)  # one that cannot be loaded is dead
    try:
        run_tests(session)
    except session.Failed:  # the first failure ends it
        return KILLED
    return KILLED if session.testsfailed else SURVIVED


def campaign(names, one_in, seed, outcome=None):
    """Judge every `one_in`-th mutant of the named targets, beginning at a place that `seed` gives; those counted are done."""
    outcome = outcome or Outcome("mutate")
    # Before the tests are loaded, whose settings begin with it. A failure is enough: it need not be made small.
    phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
    hypothesis.settings.register_profile("mutate", derandomize=True, database=None, print_blob=False, phases=phases)
    hypothesis.settings.load_profile("mutate")
    for name in names:
        target = TARGETS[name]
        source = source_of(target)
        all_of_them = list(mutants_of(source, target.functions))
        _check_justifications(outcome, name, {m.name for m in all_of_them})
        chosen = all_of_them[random.Random(seed).randrange(one_in) :: one_in][outcome.counts.get(f"mutants of {name}", 0) :]
        judging = Judge(target, partial(_judge_all, outcome, name, ast.parse(source), chosen))
        how = ["-x", "-q", "-s", "-p", "no:cacheprovider", "--no-header", "--disable-warnings"]
        code = pytest.main([*how, *target.tests], plugins=[judging])
        if code == pytest.ExitCode.INTERRUPTED:
            raise KeyboardInterrupt
        if code != pytest.ExitCode.OK or not judging.reached:
            outcome.fail(f"{name}: the tests could not be collected, or pytest ended in an error: {code!r}")
    return outcome


def _judge_all(outcome, name, unchanged, chosen, judged):
    if judged(unchanged) != SURVIVED:
        outcome.fail(f"{name}: the tests fail without any mutant")
        return
    for mutant in steps(chosen, name):
        _count(outcome, name, mutant, judged(mutant.tree))


def _count(outcome, name, mutant, verdict):
    outcome.count(f"mutants of {name}")
    if verdict is None:
        outcome.count(f"mutants of {name} that did not end")
    elif verdict == KILLED:
        outcome.count(f"mutants of {name} killed")
    elif mutant.name in JUSTIFIED[name]:
        outcome.count(f"mutants of {name} survived, justified")
    else:
        outcome.count(f"mutants of {name} survived")
        outcome.fail(f"{name}: survived: {mutant.name}")
        print(f"survived: {mutant.name}", file=sys.stderr, flush=True)


def _check_justifications(outcome, name, there):
    for gone in set(JUSTIFIED[name]) - there:
        outcome.fail(f"{name}: a justification for a mutant that is none any more: {gone}")


def main():
    parser = options(__doc__, resumable=True, one_in=1)
    parser.add_argument("--module", choices=[*TARGETS, "all"], default="all")
    given = parser.parse_args()
    names = list(TARGETS) if given.module == "all" else [given.module]
    return carried_out("mutate", given, lambda outcome: campaign(names, given.one_in, given.seed, outcome))


if __name__ == "__main__":
    sys.exit(main())
