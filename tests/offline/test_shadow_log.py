"""A simulated plant along a log: what it says is what the process beside the run would have said."""

import json
from pathlib import Path

import numpy as np
import pytest

from softloop.controller.config import ControllerConfig
from softloop.deploy.bench import shipped_benches
from softloop.deploy.follow_log import follow_run
from softloop.offline.closed_loop import RigTables, simulate_trace
from softloop.offline.log import Log
from softloop.offline.shadow_log import FIGURES, figures, follow
from softloop.plant.config import PlantConfig
from softloop.plant.shadow import Shadow
from softloop.plant.shadow_config import ShadowConfig, ShadowProcess
from softloop.wire.errors import BadConfig, BadFile
from softloop.wire.messages import message
from softloop.wire.schedule import make_schedule


def process(**keys):
    return ShadowProcess(ShadowConfig(**keys), 500_000)


@pytest.fixture(scope="module")
def log():
    """What a rig of seed 1 leaves that follows T2 for 4 s."""
    controller = ControllerConfig(trajectory="t2", approach_s=1.0)
    trace = simulate_trace(RigTables(controller, PlantConfig(seed=1)), make_schedule(0.5, 4.0, 0.5))
    channels = {"valves": trace.statuses, "pressure": trace.pressures, "inclination": trace.inclinations}
    return Log(Path("made.mcap"), channels=channels)


def test_it_says_what_a_shadow_says_that_hears_the_messages_live(log):
    live = Shadow(process(seed=2))
    kinds = {"valves": "ValveStatus", "pressure": "PressureSample", "inclination": "InclinationSample"}
    heard = [(name, message(kind).Tuple(*one.tolist())) for name, kind in kinds.items() for one in log[name]]
    for name, sample in heard:
        live.put(name, sample)
    expected = live.advance_to(max(sample.stamp_ns for _, sample in heard))
    assert [str(one) for one in follow(log, process(seed=2))] == [str(one) for one in expected]


def test_figures_tell_a_twin_from_another_specimen_and_progress_is_told(log):
    seen = []
    twin = figures(follow(log, process(seed=1), lambda done, total: seen.append((done, total))))
    other = figures(follow(log, process(seed=2)))
    assert twin["angle, deg"]["rms"] < 0.08
    assert other["angle, deg"]["rms"] > 20 * twin["angle, deg"]["rms"]
    assert all(one["most"] >= one["rms"] for one in (*twin.values(), *other.values()))
    assert seen[0][0] == 0
    assert seen[-1][0] < seen[-1][1] == sum(len(log[name]) for name in ("valves", "pressure", "inclination"))


def test_nothing_said_has_no_figures():
    assert set(figures([])) == set(FIGURES)
    assert all(np.isnan(one["rms"]) for one in figures([]).values())


def test_a_log_without_currents_is_refused(log):
    without = Log(Path("made.mcap"), channels={name: log[name] for name in ("pressure", "inclination")})
    with pytest.raises(BadFile, match="nothing on channel 'valves'"):
        follow(without, process())


def test_a_bench_without_a_shadow_is_refused(long_run):
    with pytest.raises(BadConfig, match=r"no table \[shadow\]"):
        follow_run(Path("sim"), long_run, as_json=True)


def test_the_command_prints_its_figures_as_json_and_as_a_table(long_run, tmp_path, capsys):
    bench = tmp_path / "b.toml"
    bench.write_text(f'base = "{shipped_benches()["sim"]}"\n[shadow]\nseed = 1\n')
    assert follow_run(bench, long_run, as_json=True) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found["figures"]) == set(FIGURES)
    assert len(found["said"]) > 100
    assert follow_run(bench, long_run, as_json=False) == 0
    assert "chamber, kPa" in capsys.readouterr().out
