"""The shipped mixed rig, its real inclinometer's address replaced by a pseudo-terminal: the same bench file otherwise."""

import pytest

from softloop.deploy.bench import load_bench, shipped_benches
from softloop.deploy.doctor_devices import bus_is_simulated, inclinometer_is_simulated
from softloop.offline.log import open_log
from tests.deploy.wt931_on_a_pty import Wt931
from tests.rig.rigs import running
from tests.rig.test_whole_rig import WIDE

ANGLE_DEG = 33.0


def test_the_shipped_mixed_rig_has_a_real_inclinometer_and_nothing_else_real():
    bench = load_bench(shipped_benches()["mixed"])
    assert (inclinometer_is_simulated(bench), bus_is_simulated(bench, "can0")) == (False, True)
    assert bench.inclinometer.port.startswith("/dev/")


@pytest.mark.rig
@pytest.mark.long
def test_a_mixed_rig_runs_and_its_angle_is_the_real_devices(tmp_path):
    (tmp_path / "wide.toml").write_text(f'base = "{shipped_benches()["mixed"]}"\n{WIDE}')
    imu = Wt931(tmp_path / "imu", rate_hz=200, baud=115_200)
    imu.angle_deg = ANGLE_DEG
    # The device is a Python thread here, and the machine may be busy: the controller's budgets are wide as the gate's are.
    text = (
        f'base = "{tmp_path}/wide.toml"\n[inclinometer]\nport = "{tmp_path}/imu"\n'
        "[controller]\npressure_budget_ms = 90.0\ninclination_budget_ms = 90.0\n"
    )
    with running(text, name="mixed-tested", arguments=("--duration", "2", "--no-report")) as rig:
        code = rig.finish()
        imu.end()
        assert code == 0, rig.output + rig.logs()
        log = open_log(rig.run_dir / "run.mcap")
        angles, truth = log["inclination"]["angle_deg"], log["truth"]
        assert abs(angles - ANGLE_DEG).max() < 0.1
        assert len(angles) > 100
        assert log["pressure"]["chamber_pressure_kpa"].max() > 1.0  # the simulated valves work
        assert len(truth)
