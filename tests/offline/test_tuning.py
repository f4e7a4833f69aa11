"""Tuning and evaluation: cost, search, the files they leave and read, and what a trial says."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest

from softloop.controller.config import ControllerConfig
from softloop.offline.closed_loop import simulate_run
from softloop.offline.evaluation import CONDITIONS, OWN, Condition, figures, judge_law
from softloop.offline.trials import PAYLOAD_ON_S, Trial, judge, lead_s, run_trial
from softloop.offline.tuning import (
    LOST,
    OVER_QUIET,
    QUIET_PER_S,
    Latency,
    as_toml,
    cost,
    cost_of,
    start_config,
    tune,
    with_gains,
)
from softloop.offline.tuning_ranges import RANGES
from softloop.plant.config import LoadConfig, PlantConfig

GOOD = Trial(1.0, 0.5, steady_deg=0.3, switches_per_s=QUIET_PER_S, effort_ma_s=0.0, peak_deg=1.5, left_peak_deg=1.5)


def test_every_bar_that_is_just_met_costs_one():
    assert cost_of(GOOD, None) == pytest.approx(3.5 - 0.5)  # T1, steady, and the two peaks at half weight
    assert cost_of(None, GOOD) == pytest.approx(1.0)
    restless = replace(GOOD, switches_per_s=2.0 * QUIET_PER_S)
    assert cost_of(restless, None) == pytest.approx(cost_of(GOOD, None) + OVER_QUIET)


def test_the_worst_rig_counts_as_much_as_the_mean_of_all():
    controller = start_config("pid")
    alone = [cost(controller, Latency(), [seed]) for seed in (1000, 1002)]
    filler = cost(controller, Latency(), [1000, 1001]) - alone[0]  # T2 of the rig whose turn is the second
    both = cost(controller, Latency(), [1000, 1001, 1002])
    assert both == pytest.approx(0.5 * (sum(alone) / 2 + max(alone)) + filler)


@pytest.mark.parametrize("law", RANGES)
def test_ranges_name_gains_that_exist_and_the_start_holds_them(law):
    gains = {name: np.sqrt(low * high) for name, (low, high) in RANGES[law].items()}
    found = with_gains(start_config(law), gains).model_dump()
    for name, value in gains.items():
        table, _, key = name.rpartition(".")
        assert (found[table] if table else found)[key] == value


def test_added_latency_is_split_and_declared():
    latency = Latency(40.0)
    assert latency.plant(PlantConfig()).command_delay_ms == latency.plant(PlantConfig()).measurement_delay_ms == 20.0
    told, base = latency.controller(ControllerConfig()), ControllerConfig()
    assert told.actuation_delay_ms == base.actuation_delay_ms + 20.0
    assert told.inclination_budget_ms == base.inclination_budget_ms + 40.0


def test_the_search_finds_better_gains_than_it_starts_from_and_its_file_gives_them_back():
    found = tune("pid", Latency(), [1000], evaluations=20, search_seed=3)
    middle = {name: float(np.sqrt(low * high)) for name, (low, high) in RANGES["pid"].items()}
    assert found.evaluations >= 20
    assert found.cost < cost(with_gains(start_config("pid"), middle), Latency(), [1000]) < LOST
    again = ControllerConfig.model_validate(tomllib.loads(as_toml(found))["controller"])
    assert again == with_gains(start_config("pid"), found.gains)


def test_a_trial_looks_at_the_truth_and_finds_the_payload():
    controller = ControllerConfig.model_validate({"law": "arc_eso", "actuation": {"modes": "latched", "flow_hold_kpa_s": 25.0}})
    found = run_trial(controller, PlantConfig(seed=2), payload=True)
    assert 0.1 < found.peak_deg < 1.5
    assert found.left_peak_deg > 0.1
    free = run_trial(controller, PlantConfig(seed=2))
    assert free.peak_deg == free.recovery_s == 0.0
    assert free.max_deg < found.max_deg


def test_a_run_that_the_gate_breaks_off_is_lost():
    controller = ControllerConfig(law="arc")
    wall = LoadConfig(kind="payload", on_s=lead_s(controller) + PAYLOAD_ON_S, size=1.0)
    run = simulate_run(controller, PlantConfig(seed=1, loads=(wall,)))
    run.completed = False
    assert judge(run).max_deg > 100.0


def test_conditions_reach_the_plant():
    controller = ControllerConfig()
    noisy = next(c for c in CONDITIONS if c.name == "noise doubled").plant(3, controller)
    assert noisy.angle_noise_deg == 2 * PlantConfig().angle_noise_deg
    assert next(c for c in CONDITIONS if c.ambient_c is not None).plant(3, controller).ambient_c == 0.0
    assert Condition("late", added_ms=20.0).plant(3, controller).command_delay_ms == 10.0
    drop = next(c for c in CONDITIONS if c.supply_loss).plant(3, controller)
    assert drop.faults[0].kind == "supply_loss"


def test_figures_count_the_rigs_that_keep_their_bars():
    controller = ControllerConfig.model_validate({"law": "arc_eso", "actuation": {"modes": "latched", "flow_hold_kpa_s": 25.0}})
    found = figures(judge_law(controller, OWN, [4]))
    assert found["rigs"] == found["bars_kept"] == found["payload_kept"] == found["paper_kept"] == 1
    assert found["t2_max_deg"]["worst"] == found["t2_max_deg"]["median"]
