"""Curves of a log as vector pictures."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
import synthetic

from softloop.deploy.plotting import plot_run
from softloop.offline.log import open_log
from softloop.offline.plot import Curve, curve, plot, thinned, unit_of
from softloop.offline.vector import save
from softloop.wire.errors import BadConfig, BadFile


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plot")
    synthetic.write_log(folder / "run.mcap", list(synthetic.messages(2.0)))
    return folder


@pytest.fixture(scope="module")
def log(run):
    return open_log(run / "run.mcap")


def test_units_come_from_names():
    assert [unit_of(n) for n in ("angle_deg", "rate_deg_s", "charge_current_ma", "woken_ns", "tick")] == [
        "°",
        "°/s",
        "mA",
        "ms",
        "",
    ]


def test_a_curve_is_what_was_logged_in_a_span_of_time(log):
    whole = curve(log, "cycle.angle_deg")
    np.testing.assert_array_equal(whole.values, log["cycle"]["angle_deg"])
    part = curve(log, "cycle.angle_deg", 0.5, 1.0)
    assert 0.5 <= part.time_s[0] < part.time_s[-1] <= 1.0
    assert set(curve(log, "cycle.theta[3]").values) == {3.0}
    ages = curve(log, "cycle.pressure_age_ns")
    np.testing.assert_allclose(ages.values, log["cycle"]["pressure_age_ns"] * 1e-6)


@pytest.mark.parametrize(
    ("name", "error", "said"),
    [
        ("cycle", BadConfig, "CHANNEL.FIELD"),
        ("cycle.speed", BadConfig, "no field 'speed'; it has: seq"),
        ("nothing.angle", BadFile, "no channel 'nothing'"),
        ("cycle.theta", BadConfig, r"one of \[0\] to \[13\]"),
        ("cycle.theta[14]", BadConfig, r"one of \[0\] to \[13\]"),
        ("cycle.angle_deg[0]", BadConfig, "not an array"),
    ],
)
def test_what_cannot_be_drawn_is_said(log, name, error, said):
    with pytest.raises(error, match=said):
        curve(log, name)


def test_nothing_in_the_span_is_said(log):
    with pytest.raises(BadFile, match=r"it spans 0\.100 to"):
        curve(log, "cycle.angle_deg", 90.0)


def test_thinning_keeps_every_spike_and_the_ends():
    values = np.zeros(1_000_003)
    values[[17, 500_000]] = 1.0, -1.0
    values[700_000] = np.nan
    thin = thinned(Curve("x", "", np.arange(values.size) * 1.0, values), 2000)
    assert len(thin.values) <= 2010 + 1000
    assert (thin.values.max(), thin.values.min()) == (1.0, -1.0)
    assert (np.diff(thin.time_s) > 0).all()


def test_one_panel_for_each_unit(log):
    figure = plot([curve(log, f"cycle.{n}") for n in ("angle_deg", "reference_deg", "charge_current_ma")])
    assert [axis.get_ylabel() for axis in figure.axes] == ["°", "mA"]
    assert [len(axis.lines) for axis in figure.axes] == [2, 1]


@pytest.mark.parametrize("ending", ["svg", "pdf", "png"])
def test_a_picture_is_of_the_kind_asked_for_and_the_same_each_time(log, tmp_path, ending):
    kinds = {"svg": b"<?xml", "pdf": b"%PDF", "png": b"\x89PNG"}
    first, second = (
        save(plot([curve(log, "cycle.angle_deg")]), tmp_path / f"{n}.{ending}").read_bytes() for n in ("first", "second")
    )
    assert first == second
    assert first.startswith(kinds[ending])
    if ending == "svg":
        assert ET.fromstring(first).tag == "{http://www.w3.org/2000/svg}svg"
        assert b"<!-- cycle.angle_deg -->" in first  # the letters are outlines


def test_the_command_writes_beside_the_log(run, capsys):
    assert plot_run(run, ["cycle.angle_deg"], None, -np.inf, np.inf) == 0
    assert capsys.readouterr().out.strip() == str(run / "plot.svg")
    assert (run / "plot.svg").stat().st_size > 1000
    with pytest.raises(BadConfig, match=r"one of: \.svg"):
        plot_run(run, ["cycle.angle_deg"], run / "plot.jpeg", -np.inf, np.inf)
    with pytest.raises(BadFile, match="cannot be written"):
        plot_run(run, ["cycle.angle_deg"], run / "no" / "plot.svg", -np.inf, np.inf)
