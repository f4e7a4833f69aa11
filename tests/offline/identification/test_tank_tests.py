"""Flow tests on a tank: the valves' true numbers come back; without a volume ratios do, and the rank says what is missing."""

import numpy as np
import pytest

from softloop.controller.config import ControllerConfig
from softloop.dynamics.parameters import load_parameters, shipped
from softloop.offline.closed_loop import SETTLE_S, RigTables, ready_controller, simulate_trace
from softloop.offline.identification.tank_tests import Volume, Windows, fit_on_tank, fit_ratios, flow_tests, joined
from softloop.offline.log import open_log
from softloop.offline.trace_log import write_trace
from softloop.plant.config import PlantConfig
from softloop.wire.errors import BadFile
from softloop.wire.schedule import make_schedule

TANK_ML = 500.0
TRUE = load_parameters(shipped()).charge
SUPPLIES = (150.0, 175.0, 200.0)


def tank_log(folder, supply_kpa, layer="ideal", **valve_test):
    given = {"law": "valve_test", "trajectory": "valve_steps", "valve_test": valve_test}
    controller = ControllerConfig.model_validate(given)
    plant = PlantConfig(layer=layer, tank_ml=TANK_ML, supply_kpa=supply_kpa, ambient_c=20.0)
    built = ready_controller(controller)
    schedule = make_schedule(SETTLE_S, controller.approach_s + built.plan.duration_s + 0.1, 0.5)
    path = folder / f"{layer}_{supply_kpa:g}.mcap"
    write_trace(path, simulate_trace(RigTables(controller, plant), schedule, built), "tank", {})
    return open_log(path)


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tank")
    return [tank_log(folder, supply) for supply in SUPPLIES]


def of_valve(logs, volume, valve):
    return joined([flow_tests(log, volume)[valve] for log in logs])


def test_all_five_numbers_of_the_charge_valve_come_back(logs):
    volume = Volume(1e-6 * TANK_ML)
    found = fit_on_tank(of_valve(logs, volume, "charge"), volume, 0.8)
    assert (found.rank, found.fit > 99.0) == (5, True)
    assert found.values[0] == pytest.approx(TRUE.k_v1_m2_ma.value, rel=0.03)
    assert found.values[3] == pytest.approx(TRUE.k_v6_m2.value, rel=0.03)


def test_the_exhaust_valves_downstream_never_changes_so_its_ratio_has_no_number(logs):
    volume = Volume(1e-6 * TANK_ML)
    found = fit_on_tank(of_valve(logs, volume, "exhaust"), volume, 0.8)
    assert found.rank == 4
    assert found.shown == ("k_v1_m2_ma", "k_v2_pa", "k_v3_m2_pa", "k_v6_m2")
    assert found.uncertainty.values[0] == pytest.approx(TRUE.k_v1_m2_ma.value, rel=0.05)


def test_an_error_of_the_volume_is_in_the_intervals_that_it_bears_on(logs):
    exact, rough = Volume(1e-6 * TANK_ML), Volume(1e-6 * TANK_ML, error=0.05)
    tests = of_valve(logs, exact, "charge")
    before, after = fit_on_tank(tests, exact, 0.8).uncertainty, fit_on_tank(tests, rough, 0.8).uncertainty
    assert after.errors[0] == pytest.approx(np.hypot(before.errors[0], 0.05 * before.values[0]))
    assert after.errors[1] == before.errors[1]


def test_without_a_volume_ratios_are_given_and_the_volume_is_not(logs):
    nominal = Volume(40e-6)  # far from the truth, and it must not matter
    found = fit_ratios(of_valve(logs, nominal, "charge"), nominal, 0.8)
    assert found.rank == 5
    assert found.names == ("k_v1_m2_ma / V", "k_v2_pa", "k_v3_m2_pa / V", "k_v6_m2 / V", "ratio")
    assert found.sure.values[0] == pytest.approx(TRUE.k_v1_m2_ma.value / (1e-6 * TANK_ML), rel=0.03)


def test_pressures_stay_within_the_limits(logs):
    for log in logs:
        chamber = log["truth"]["chamber_pressure_kpa"]
        assert 100.0 < chamber.max() < 165.0
        assert log["valves"]["gate"].max() < 2


def test_the_actuator_is_off_while_a_tank_is_on(logs):
    angle = logs[0]["truth"]["angle_deg"]
    assert np.ptp(angle) < 1e-6


def test_a_log_of_another_experiment_is_refused(tmp_path):
    trace = simulate_trace(RigTables(ControllerConfig(), PlantConfig()), make_schedule(SETTLE_S, 0.5, 0.1))
    write_trace(tmp_path / "run.mcap", trace, "b", {})
    with pytest.raises(BadFile, match="no flow test"):
        flow_tests(open_log(tmp_path / "run.mcap"), Volume(1e-3), Windows())
