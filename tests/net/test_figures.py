"""Which runs on a network are refused, and for what."""

import json

import pytest

from tests.net.__main__ import finite
from tests.net.figures import Cell, failures

GOOD = {
    "gate_faults": 0,
    "gate_fault_reasons": "",
    "silent_channels": "",
    "tick_late_p99_us": 300.0,
    "ticks": 2000,
    "ticks_skipped": 0,
    "truth_error_max_deg": 1.0,
    "off_ms": None,
    "was_armed": True,
    "charge_max_ma": 70.0,
    "pressure_age_p50_ms": 4.0,
    "inclination_age_p50_ms": 3.0,
}


def cell(loss=0.0, codes=0, delay_ms=1.0, clocks=("board", "logger"), inside=1.0, **figures):
    network = {"delay_ms": delay_ms, "jitter_ms": 0.0, "loss": loss, "by": "relay"}
    return Cell(network, {"desk": codes}, GOOD | figures, {name: {"inside": inside} for name in clocks})


def test_a_good_run_keeps_all_bounds():
    assert failures(cell()) == []
    assert cell().outcome == "armed"


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"codes": 4}, "exit codes"),
        ({"gate_faults": 1, "gate_fault_reasons": "not_ready", "off_ms": 3.0}, "not_ready"),
        ({"truth_error_max_deg": 3.68}, "off by"),
        ({"truth_error_max_deg": None}, "off by"),
        ({"tick_late_p99_us": 2501.0}, "late"),
        ({"ticks_skipped": 21}, "skipped"),
        ({"silent_channels": "truth never heard"}, "lost a channel"),
        ({"pressure_age_p50_ms": 1e6}, "pressure ages"),
        ({"inclination_age_p50_ms": -1e6}, "inclination ages"),
        ({"pressure_age_p50_ms": None}, "pressure ages"),
        ({"inside": 0.9}, "inside"),
        ({"clocks": ("board",)}, "clocks"),
    ],
)
def test_what_is_wrong_is_said(wrong, word):
    assert any(word in text for text in failures(cell(**wrong)))


@pytest.mark.parametrize(
    ("loss", "off_ms", "good"),
    [(0.05, 3.0, True), (0.05, 12.4, True), (0.05, 12.5, False), (0.05, float("inf"), False), (0.0, 3.0, False)],
)
def test_a_vent_is_an_answer_to_loss_alone_and_must_come_at_once(loss, off_ms, good):
    vented = cell(loss=loss, codes=1, gate_faults=1, off_ms=off_ms, truth_error_max_deg=None)
    assert vented.outcome == "vented"
    assert (failures(vented) == []) is good


@pytest.mark.parametrize(("loss", "charge_max_ma", "good"), [(0.05, 0.4, True), (0.05, 2.0, False), (0.0, 0.4, False)])
def test_not_to_arm_is_an_answer_to_loss_alone_and_without_current(loss, charge_max_ma, good):
    refused = cell(loss=loss, codes=1, was_armed=False, charge_max_ma=charge_max_ma, truth_error_max_deg=None)
    assert refused.outcome == "not armed"
    assert (failures(refused) == []) is good


def test_a_run_without_a_log_fails():
    assert failures(Cell({"loss": 0.0}, {"desk": 3})) != []


def test_the_json_is_json():
    assert json.loads(json.dumps(finite({"a": [float("inf"), 1.0, {"b": (float("nan"), "x")}]}))) == {
        "a": [None, 1.0, {"b": [None, "x"]}]
    }
