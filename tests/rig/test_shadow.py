"""A simulated plant that follows a whole rig: how far from it, and that the rig does not notice it."""

import signal
import time

import numpy as np
import pytest

from softloop.deploy.bench import shipped_benches
from softloop.offline.run_log import open_run
from softloop.offline.same import series_of
from tests.rig.rigs import running
from tests.rig.test_whole_rig import ARMED, bench_on

BASE = f'base = "{shipped_benches()["sim"]}"\n[pace]\nmode = "lockstep"\ntimeout_s = 60.0\n'
LOCKSTEP = BASE + "[run]\nsettle_s = 0.3\nduration_s = 1.5\nvent_timeout_s = 0.3\n[controller]\napproach_s = 0.8\n"
AS_NOISE = {"angle_rms_deg": 0.1, "chamber_rms_kpa": 0.2, "supply_rms_kpa": 0.2}


def lockstep_log(name, tables):
    with running(LOCKSTEP + tables, name=name, arguments=["--no-report", "--quiet"]) as rig:
        assert rig.finish() == 0, rig.output + rig.logs()
        return open_run(rig.run_dir)


@pytest.mark.long
def test_at_lockstep_a_twin_is_as_far_as_noise_another_specimen_farther_and_the_run_is_the_same():
    alone = lockstep_log("shadowed", "")
    twin, again = (lockstep_log("shadowed", "[shadow]\nseed = 1\n") for _ in range(2))
    other = lockstep_log("shadowed", "[shadow]\nseed = 2\n")
    assert len(twin["shadow"]) > 20
    for field, most in AS_NOISE.items():
        assert np.nanmax(twin["shadow"][field]) < most, field
    assert np.nanmax(other["shadow"]["angle_rms_deg"]) > 5 * np.nanmax(twin["shadow"]["angle_rms_deg"])
    assert twin["shadow"].tobytes() == again["shadow"].tobytes()
    for series in ("command", "cycle", "valves", "pressure", "inclination", "truth"):
        assert series_of(alone)[series].tobytes() == series_of(twin)[series].tobytes(), series


@pytest.mark.long
def test_at_wall_pace_stopping_and_killing_it_changes_nothing_and_it_is_brought_back(tmp_path):
    with running(bench_on("sim", tmp_path) + "[shadow]\nseed = 1\n", name="shadow-wall", arguments=["--no-report"]) as rig:
        rig.wait_for_word(ARMED)
        shadow = rig.named("shadow")
        shadow.send_signal(signal.SIGSTOP)
        time.sleep(0.5)
        shadow.send_signal(signal.SIGKILL)
        rig.wait_for_word("process 'shadow' is back")
        assert rig.finish() == 0, rig.output + rig.logs()
        log = open_run(rig.run_dir)
        assert len(np.unique(log["shadow"]["since_ns"])) == 2
        assert not (log["valves"]["gate"] == 2).any()
