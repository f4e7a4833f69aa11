"""The three contracts: a lockstep run comes out the same again, in a replay, and in one process; and what ends one early.

`make test` has the arc on the rig layer; `make exact` every law on both layers. Both cores are kept busy by another load.
"""

import signal

import numpy as np
import pytest

from softloop.deploy.bench import load_bench, shipped_benches
from softloop.deploy.same import differences_from_batch, trace_of
from softloop.offline.log import open_log
from softloop.offline.replay import replay
from softloop.offline.same import differences
from softloop.wire.messages import constant
from tests.rig.lockstep_benches import LAWS, busy_cores, eventful
from tests.rig.rigs import running

SIM = shipped_benches()["sim"]
KIND_FAULT, KIND_LOAD, KIND_DRIVER = (constant("Event", f"KIND_{k}") for k in ("FAULT", "LOAD", "DRIVER"))


def run_of(text, expected=1):
    """The log of a run, and what its bench leaves in one process; it ends in a FAULT, because its driver hears no more."""
    with running(text, name="exact") as rig:
        rig.finish(expected)
        assert rig.left_over() == []
        log = open_log(rig.run_dir / "run.mcap")
        assert log.problems == []
        return log, trace_of(load_bench(rig.run_dir / "bench.toml", rig.run_dir))


def hold_contracts(text):
    with busy_cores():
        (a, trace), (b, _) = run_of(text), run_of(text)
    assert [str(d) for d in differences(a, b)] == []
    assert [str(d) for d in differences_from_batch(a, trace)] == []
    assert len(a["cycle"]) == len(trace.cycles) > 500
    return a


def assert_eventful(log):
    """What the contracts were held over did happen."""
    events = log["event"]
    assert {int(k) for k in events["kind"]} >= {KIND_FAULT, KIND_LOAD, KIND_DRIVER}
    assert np.count_nonzero(events["code"][events["kind"] == KIND_DRIVER] == constant("ValveStatus", "DRIVER_WATCHDOG")) > 0
    assert len(np.unique(log["cycle"]["mode"])) == 3
    assert log["valves"]["gate"][-1] == constant("ValveStatus", "GATE_FAULT")
    assert len(log["inclination"]) != len(log["cycle"])  # its clock is its own
    assert log["pressure"]["missed"][-1] > 0


@pytest.mark.rig
def test_the_three_contracts_hold_while_much_happens(tmp_path):
    log = hold_contracts(eventful(SIM))
    assert_eventful(log)
    result = replay(log)
    assert result.equal
    assert result.compared == result.ticks == len(log["cycle"])
    assert result.commands == result.ticks


@pytest.mark.exact
@pytest.mark.parametrize("layer", ["ideal", "rig"])
@pytest.mark.parametrize("law", LAWS)
def test_every_law_on_both_layers(law, layer):
    log = hold_contracts(eventful(SIM, law=law, layer=layer, seconds=6.0))
    assert_eventful(log)
    result = replay(log)
    assert result.equal
    assert result.compared == result.ticks


@pytest.mark.exact
def test_a_whole_trajectory():
    with busy_cores():
        log, trace = run_of(f'base = "{SIM}"\n[pace]\nmode = "lockstep"\n', expected=0)
    assert [str(d) for d in differences_from_batch(log, trace)] == []
    assert replay(log).equal


def test_a_batch_run_is_changed_by_its_seed(tmp_path):
    benches = []
    for seed in (5, 6):
        (tmp_path / f"{seed}.toml").write_text('name = "exact"\n' + eventful(SIM, seed=seed))
        benches.append(trace_of(load_bench(tmp_path / f"{seed}.toml", tmp_path)))
    assert benches[0].cycles.tobytes() != benches[1].cycles.tobytes()


LONG = f'base = "{SIM}"\n[pace]\nmode = "lockstep"\ntimeout_s = 3.0\n'


@pytest.mark.rig
@pytest.mark.parametrize(
    ("process", "number"),
    [("pressures", signal.SIGKILL), pytest.param("inclinometer", signal.SIGSTOP, marks=pytest.mark.long)],
)
def test_a_lost_process_ends_it_with_a_word_that_names_it(process, number):
    with running(LONG, name="lost") as rig:
        rig.wait_for_word("gate armed")
        rig.named(process).send_signal(number)
        rig.finish(4)
        assert f"'{process}'" in rig.output.splitlines()[-1] or f"'{process}'" in rig.output, rig.output
        assert rig.left_over() == []


@pytest.mark.rig
@pytest.mark.long
def test_ctrl_c_ends_it():
    with running(LONG, name="interrupted") as rig:
        rig.wait_for_word("gate armed")
        rig.signal(signal.SIGINT)
        rig.finish(130)
        assert rig.left_over() == []
