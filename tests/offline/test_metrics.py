"""Figures of synthetic runs against values that are known by construction."""

import numpy as np
import pytest
import synthetic

from softloop.offline import metrics
from softloop.offline.log import open_log
from softloop.wire.messages import message


@pytest.fixture(scope="module")
def log(long_run):
    return open_log(long_run / "run.mcap")


def records(name, n, **columns):
    made = np.zeros(n, message(name).dtype)
    for column, values in columns.items():
        made[column] = values
    return made


def test_interpolation_of_stamps_of_a_machine_that_runs_for_months():
    base = 9_000_000_000_000_000
    stamps = base + np.array([0, 5, 10], np.int64)
    found = metrics.interpolate(base + np.array([-3, 1, 9, 50], np.int64), stamps, np.array([0.0, 10.0, 0.0]))
    assert found.tolist() == [0.0, 2.0, 2.0, 0.0]


def test_interpolation_of_nothing():
    assert np.isnan(metrics.interpolate(np.array([1, 2]), np.zeros(0, np.int64), np.zeros(0))).all()


def test_the_first_sample_of_track_counts(log):
    errors = metrics.truth_errors(log)
    track = metrics.tracked(log)
    assert errors.time_s[0] == 0.0
    assert len(errors.error_deg) == len(track) == len(log["cycle"]) - synthetic.APPROACH_TICKS
    # The error decays, so that leaving anything out at the start would show.
    assert errors.figures()["max_deg"] == pytest.approx(np.abs(errors.error_deg[:40]).max())
    assert errors.figures()["max_at_s"] < 0.2


def test_errors_of_a_known_sine():
    t = np.arange(400) * 0.005
    cycles = records("CycleRecord", 400, stamp_ns=(t * 1e9).astype(np.int64), phase=2, reference_rate_deg_s=1.0)
    errors = metrics.errors_at(cycles["stamp_ns"], 3.0 * np.sin(2 * np.pi * t), cycles)
    figures = errors.figures()
    assert figures["max_deg"] == pytest.approx(3.0, abs=1e-3)
    assert figures["rms_deg"] == pytest.approx(3.0 / np.sqrt(2.0), rel=1e-6)
    assert figures["steady_deg"] is None


def test_dwells_are_stretches_of_two_seconds_in_which_the_reference_stands():
    rate = np.concatenate([np.zeros(401), np.ones(50), np.zeros(399), np.ones(1), np.zeros(600)])
    cycles = records("CycleRecord", len(rate), stamp_ns=np.arange(len(rate)) * 5_000_000, reference_rate_deg_s=rate)
    assert metrics.dwells(cycles) == [(0, 401), (851, 1451)]
    spans = metrics.steady_spans_ns(cycles)
    assert [round((b - a) * 1e-9, 9) for a, b in spans] == [2.0, 2.0]
    assert spans[1][1] == 1450 * 5_000_000


def test_the_steady_error_is_the_worst_of_the_last_two_seconds_only():
    n = 1001
    cycles = records("CycleRecord", n, stamp_ns=np.arange(n) * 5_000_000)
    error = np.zeros(n)
    error[n - 402] = 9.0  # just before the last 2 s
    error[n - 401] = -0.7  # their first sample
    assert metrics.errors_at(cycles["stamp_ns"], error, cycles).figures()["steady_deg"] == pytest.approx(0.7)


def test_a_reference_without_an_angle_has_no_angle_error(log):
    errors = metrics.Errors(np.zeros(2), np.array([np.nan, 1.0]), np.zeros(2, bool))
    assert set(errors.figures().values()) == {None}


def test_the_sensors_age_is_no_tracking_error(log):
    """The synthetic sensor reports the true angle of its tick plus 0.01 deg, stamped 4.5 ms before."""
    errors = metrics.sensor_errors(log)
    cycles = metrics.tracked(log)
    sample = log["inclination"][synthetic.APPROACH_TICKS + 100]
    expected = sample["angle_deg"] - np.interp(sample["stamp_ns"], cycles["stamp_ns"], cycles["reference_deg"])
    assert np.isclose(errors.error_deg, expected, atol=1e-6).any()


def test_every_hop_has_the_length_that_the_stamps_say(log):
    h = synthetic.HOPS_NS
    found = metrics.latencies_us(log, "inclination")
    expected = {
        "wire": h["inclination_received"] - h["inclination_sampled"],
        "adapter": h["inclination_published"] - h["inclination_received"],
        "wait": h["woken"] - h["inclination_published"],
        "compute": h["computed"] - h["woken"],
        "publish": h["published"] - h["computed"],
        "zenoh": h["gate_received"] - h["published"],
        "gate": h["frame_sent"] - h["gate_received"],
        "frame": h["applied"] - h["frame_sent"],
        "total": h["applied"] - h["inclination_sampled"],
        "to_bus": h["frame_sent"] - h["inclination_sampled"],
    }
    assert set(found) == set(expected)
    for hop, values in found.items():
        known = values[np.isfinite(values)]
        assert len(known) >= len(values) - 1, hop  # truth has not yet seen the last command
        assert known == pytest.approx(expected[hop] * 1e-3), hop


def test_hops_add_up_to_the_total(log):
    for sensor in metrics.SENSORS:
        found = metrics.latencies_us(log, sensor)
        together = sum(found[hop] for hop, _, _ in metrics.HOPS)
        known = np.isfinite(together)
        assert known.sum() > 1000
        assert together[known] == pytest.approx(found["total"][known])


def test_a_held_command_counts_at_its_first_frame():
    valves = records("ValveStatus", 3, seq=[1, 2, 3], command_seq=[1, 1, 1], stamp_ns=[100, 200, 300], command_received_ns=90)
    command = records("ValveCommand", 1, seq=1, tick=7)
    cycles = records("CycleRecord", 1, tick=7, published_ns=50)
    log = type("L", (), {"__getitem__": lambda self, name: {"command": command, "valves": valves, "truth": command[:0]}[name]})()
    found = metrics._gate_points(log, cycles)
    assert found["frame_sent"].tolist() == [100.0]
    assert np.isnan(found["applied"]).all()


def test_a_frame_that_truth_did_not_see_has_no_application():
    truth = records("PlantTruth", 3, command_end_ns=[0, 1270, 3270], command_applied_ns=[0, 1280, 3280])
    frames = np.array([1000, 2000, 3000])
    found = metrics.applied_ns(frames, frames, truth)
    assert found[0] == 1280
    assert np.isnan(found[1])
    assert found[2] == 3280


def test_percentiles_are_values_that_occurred():
    values = np.arange(1.0, 1001.0)
    assert metrics.spread(values) == {"p50": 501.0, "p99": 991.0, "p99_9": 1000.0, "max": 1000.0}
    assert metrics.spread(np.array([np.nan])) == {"p50": None, "p99": None, "p99_9": None, "max": None}


def test_mode_switches():
    cycles = records("CycleRecord", 201, stamp_ns=np.arange(201) * 5_000_000, mode=np.arange(201) // 50 % 2)
    assert metrics.switches_per_s(cycles, [(0, 201)]) == pytest.approx(4.0)
    assert metrics.switches_per_s(cycles, [(10, 40)]) == 0.0
    assert metrics.switches_per_s(cycles, []) is None


def test_losses_by_sender():
    events = records("Event", 5, seq=[1, 2, 1, 3, 3], source=[1, 1, 2, 2, 2])
    assert metrics._losses(events, "Event") == (5, 1, 1)
    assert metrics._losses(records("PressureSample", 4, seq=[5, 6, 9, 7]), "PressureSample") == (4, 1, 0)
    assert metrics._losses(events[:0], "Event") == (0, 0, 0)


def test_can_frames_of_a_node_are_counted_over_all_identifiers_of_a_bus(log):
    frames = records("CanFrame", 3, seq=[1, 3, 5], node=4)
    others = records("CanFrame", 2, seq=[2, 4], node=4)
    log = type(log)(log.path, can={("can0", 1): frames, ("can0", 2): others, ("can1", 1): frames})
    assert metrics.losses(log)["can"] == (8, 2, 0)
