"""Scenarios on the whole rig: how they end, and that chance comes out the same again."""

import json
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

import pytest

from softloop.deploy.bench import shipped_benches
from softloop.deploy.scenario import shipped_scenarios
from softloop.offline.log import open_log
from softloop.wire.messages import constant, names_of
from tests.rig.lockstep_benches import busy_cores
from tests.rig.rigs import running

BENCH = f'base = "{shipped_benches()["sim"]}"\n'
FAULTS = {name: number for number, name in names_of("Event", "FAULT_").items()}
# A bit in each tenth byte, each twentieth frame lost, noise on an angle: all three are left to chance, on three wires.
CHANCE = """
name = "chance"
description = "Chance on three wires, then no command any more."
seed = {seed}
pace = "lockstep"
duration_s = 2.0
expected = "VENT"
[overrides.controller]
approach_s = 0.8
[[injections]]
kind = "can_drop"
target = "analog"
at_s = 0.9
duration_s = 0.7
probability = 0.05
[[injections]]
kind = "serial_drop"
target = "inclinometer"
at_s = 0.9
probability = 0.001
[[injections]]
kind = "sensor_noise"
target = "angle"
at_s = 1.0
duration_s = 0.4
size = 0.5
[[injections]]
kind = "zenoh_drop"
target = "command"
at_s = 1.7
"""


def injected(log):
    events = log["event"]
    return set(events["reason"][(events["kind"] == constant("Event", "KIND_FAULT")) & (events["code"] == 1)].tolist())


def same(a, b):
    """The exit code of `softloop same`."""
    return subprocess.run([sys.executable, "-m", "softloop.deploy.cli", "same", str(a), str(b)], check=False).returncode


@pytest.mark.exact
def test_at_lockstep_pace_the_same_scenario_gives_the_same_bytes_and_another_seed_does_not(tmp_path):
    with busy_cores(), ExitStack() as stack:
        rigs = []
        for number, seed in enumerate((7, 7, 8)):
            scenario = tmp_path / f"{number}.toml"
            scenario.write_text(CHANCE.format(seed=seed))
            rigs.append(stack.enter_context(running(BENCH, name="chance", arguments=("--no-report", "--faults", str(scenario)))))
            rigs[-1].finish(0)
            assert rigs[-1].left_over() == []
        log = open_log(rigs[0].run_dir / "run.mcap")
        assert log.problems == []
        assert injected(log) == {FAULTS[kind] for kind in ("can_drop", "serial_drop", "sensor_noise", "zenoh_drop")}
        assert [same(rigs[0].run_dir, rig.run_dir) for rig in rigs[1:]] == [0, 1]


@pytest.mark.rig
def test_the_command_runs_scenarios_and_judges_them(tmp_path):
    """One tick by tick that dies, and one by the clock whose gate is killed; and one that expects what does not come."""
    wrong = tmp_path / "wrong.toml"
    text = shipped_scenarios()["driver_power_loss"].read_text()
    wrong.write_text(text.replace('"driver_power_loss"', '"wrong"').replace('"DEAD"', '"VENT"'))
    command = [sys.executable, "-m", "softloop.deploy.cli", "faults", "driver_power_loss", "valves_killed", str(wrong), "--json"]
    with tempfile.TemporaryDirectory(prefix="sl-faults-") as runtime:  # sockets: apart from those of a user's own benches
        done = subprocess.run(
            [*command, "--out", str(tmp_path / "out")],
            env={**os.environ, "XDG_RUNTIME_DIR": runtime}, capture_output=True, text=True, timeout=180, check=False,
        )  # fmt: skip
        assert list(Path(runtime).glob("*.sock*")) == []
    assert done.returncode == 1, done.stderr
    answer = json.loads(done.stdout)
    assert answer == json.loads((tmp_path / "out" / "faults.json").read_text())
    dead, killed, other = answer["scenarios"]
    assert [row["seen"] for row in (dead, killed, other)] == ["DEAD", "VENT", "DEAD"], done.stdout + done.stderr
    assert [row["as_expected"] for row in (dead, killed, other)] == [True, True, False]
    assert (dead["vent_s"], dead["empty_s"]) == (None, None)
    assert dead["chamber_kpa"] > 10.0
    assert 0.0 < killed["vent_s"] < killed["empty_s"] < 2.0
    assert dead["events"][0] == "0.000 s plant: fault power_loss came (0)"
    assert killed["events"][0] == "0.000 s launcher: fault process_kill came (0)"
