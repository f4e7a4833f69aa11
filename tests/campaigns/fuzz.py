"""Every boundary under a million random inputs: no crash, no hang, no command let through.

    python -m tests.campaigns.fuzz [--inputs 1000000] [--target all] [--engine own] [--seed 1] [--json FILE] [--resume]

Engine `own` mutates good inputs blindly and fast; `atheris`, where that package is installed, looks for inputs that reach new
code. The gate's state machine (`gate`) is driven by Hypothesis; its inputs are counted in steps.
"""

import importlib.util
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import traceback
from pathlib import Path

from tests.campaigns.outcome import Outcome, carried_out, options, steps

HANG_S = 10.0  # of processor time for one input
CRASHES = Path("build/campaigns/crashes")
BYTES = ("can", "serial", "cdr", "bench", "parameters", "mcap")
STEPS_PER_LIFE, LIVES = 50, 500
STEPS = "inputs of gate, in steps"
EDGES = [
    b"\x00",
    b"\xff",
    b"\x7f",
    b"\x80",
    b"\xff" * 4,
    b"\xff" * 8,
    b"\x00" * 8,
    b"\x00\x00\x00\x80",
    b"nan",
    b"1e999",
    b"-1",
    b"[[",
    b'"',
]


class HangError(Exception):
    """One input took too long."""


def mutated(rng, corpus):
    """A good input with one to six places changed."""
    data = bytearray(rng.choice(corpus))
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        at, kind = rng.randrange(len(data) + 1), rng.randrange(7)
        if kind == 0 and at < len(data):
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1 and at < len(data):
            data[at] = rng.randrange(256)
        elif kind == 2:
            data[at:at] = rng.randbytes(rng.randint(1, 9))
        elif kind == 3:
            del data[at : at + rng.randint(1, 16)]
        elif kind == 4:
            edge = rng.choice(EDGES)
            data[at : at + len(edge)] = edge
        elif kind == 5:
            other = rng.choice(corpus)
            start = rng.randrange(len(other) + 1)
            data[at : at + rng.randint(0, 64)] = other[start : start + rng.randint(0, 64)]
        else:
            del data[at:]
    return bytes(data)


def _on_alarm(_number, _frame):
    raise HangError


def blind(outcome, name, inputs, seed):
    """The own engine on one target, from the input on at which its count stands."""
    from tests.campaigns.fuzz_targets import CORPORA, TARGETS  # noqa: PLC0415 - loads all of softloop

    done = outcome.counts.get(f"inputs of {name}", 0)
    rng, target, corpus = random.Random(f"{seed} {name} {done}"), TARGETS[name], CORPORA[name]()
    for good in corpus:
        target(good)
    before = signal.signal(signal.SIGVTALRM, _on_alarm)
    try:
        for _ in steps(range(done, inputs), name):
            data = mutated(rng, corpus)
            signal.setitimer(signal.ITIMER_VIRTUAL, HANG_S)
            try:
                target(data)
            except Exception as error:  # noqa: BLE001 - this is what is looked for
                _keep(outcome, name, data, error)
            outcome.count(f"inputs of {name}")
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def _keep(outcome, name, data, error):
    CRASHES.mkdir(parents=True, exist_ok=True)
    file = CRASHES / f"{name}-{len(outcome.failures)}"
    file.write_bytes(data)
    where = traceback.extract_tb(error.__traceback__)[-1]
    outcome.fail(f"{name}: {type(error).__name__} {error} at {Path(where.filename).name}:{where.lineno}; input in {file}")


def guided(outcome, name, inputs, seed):
    """Atheris on one target, in a process of its own."""
    folder = CRASHES.parent / f"corpus-{name}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    CRASHES.mkdir(parents=True, exist_ok=True)
    command = [
        sys.executable,
        "-m",
        "tests.campaigns.fuzz",
        "--be-atheris",
        name,
        str(folder),
        f"-runs={inputs}",
        f"-seed={seed}",
    ]
    command += [f"-timeout={HANG_S:.0f}", f"-artifact_prefix={CRASHES}/{name}-", "-max_len=16384", "-rss_limit_mb=4096"]
    # Instrumented functions are none that numba can compile; plain ones show their paths too.
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    ended = re.search(r"Done (\d+) runs", done.stderr)
    seen = re.findall(r"^#(\d+)", done.stderr, re.MULTILINE)  # at least so many, where it did not come to its end
    outcome.count(f"inputs of {name}", int(ended.group(1)) if ended else max(map(int, seen), default=0))
    if done.returncode or not ended:
        said = [line for line in (done.stdout + done.stderr).splitlines() if "Error" in line or "written to" in line]
        outcome.fail(f"{name}: atheris ended with {done.returncode}: {' | '.join(said[:3])}")


def be_atheris(name, folder, arguments):
    import atheris  # noqa: PLC0415

    with atheris.instrument_imports(include=["softloop"]):
        from tests.campaigns.fuzz_targets import CORPORA, TARGETS  # noqa: PLC0415
    for k, data in enumerate(CORPORA[name]()):
        (Path(folder) / f"good-{k}").write_bytes(data)
    atheris.Setup([sys.argv[0], folder, *arguments], TARGETS[name])
    atheris.Fuzz()


def machine(outcome, inputs, seed):
    """The gate's state machine under Hypothesis."""
    import hypothesis  # noqa: PLC0415

    from tests.devices.test_gate_sequences import GateMachine  # noqa: PLC0415

    outcome.count(STEPS, 0)

    class Counted(GateMachine):
        def step(self, ask=False, **fields):
            outcome.count(STEPS)
            super().step(ask, **fields)

    # A new beginning now and then: what Hypothesis notes of all lives so far would fill the memory.
    while (left := inputs - outcome.counts[STEPS]) > 0:
        settings = hypothesis.settings(
            max_examples=min(LIVES, 1 + left // STEPS_PER_LIFE), stateful_step_count=STEPS_PER_LIFE, deadline=None, database=None,
            suppress_health_check=list(hypothesis.HealthCheck),
        )  # fmt: skip
        hypothesis.seed(f"{seed} {outcome.counts[STEPS]}")(Counted)
        try:
            hypothesis.stateful.run_state_machine_as_test(Counted, settings=settings)
        except Exception as error:  # noqa: BLE001
            outcome.fail(f"gate: {error!r}")
            break


def campaign(targets, inputs, engine, seed, outcome=None):
    outcome = outcome or Outcome("fuzz")
    for name in targets:
        if name == "gate":
            machine(outcome, inputs, seed)
        elif engine == "atheris":
            guided(outcome, name, inputs, seed)
        else:
            blind(outcome, name, inputs, seed)
    return outcome


def main():
    if sys.argv[1:2] == ["--be-atheris"]:
        return be_atheris(sys.argv[2], sys.argv[3], sys.argv[4:])
    parser = options(__doc__, resumable=True, inputs=1_000_000)
    parser.add_argument("--target", choices=[*BYTES, "gate", "all"], default="all")
    parser.add_argument("--engine", choices=["own", "atheris"], default="own")
    given = parser.parse_args()
    if given.engine == "atheris" and importlib.util.find_spec("atheris") is None:
        print("fuzz: the package atheris is not installed here (pip install atheris); --engine own needs nothing")
        return 3
    targets = [*BYTES, "gate"] if given.target == "all" else [given.target]
    return carried_out("fuzz", given, lambda outcome: campaign(targets, given.inputs, given.engine, given.seed, outcome))


if __name__ == "__main__":
    sys.exit(main())
