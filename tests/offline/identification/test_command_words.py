"""What `softloop identify` says beside its answer, and what it refuses."""

import json
import re
from pathlib import Path

import models
import numpy as np
import pytest
from test_command import softloop
from test_venting import vent

from softloop.deploy import identify
from softloop.deploy.identify_files import labels
from softloop.dynamics.parameters import load_parameters

MAP = ("--map", "time=t", "--map", "pressure=p", "--map", "angle=y")
VENT_MAP = ("--map", "time=t", "--map", "pressure=p")


def bend(file, seed=1, edit=lambda rows: rows):
    """A CSV file of a known model, 10 s at 200 Hz."""
    series = models.measured(models.PAPER, models.values_of(models.PAPER), seed=seed, seconds=10.0, noise_deg=0.05)
    return save(file, "t,p,y", edit(np.column_stack([series.time_s, series.pressure_kpa[:, 0], series.angle_deg])))


def tank(file, first_kpa, seed=1):
    run = vent(first_kpa, 0.05, seed, seconds=10.0)
    return save(file, "t,p", np.column_stack([run.time_s, run.pressure_kpa]))


def save(file, head, rows):
    file.parent.mkdir(exist_ok=True)
    np.savetxt(file, rows, delimiter=",", header=head, comments="", fmt="%.9g")
    return file


@pytest.fixture
def cut_off(excitation, tmp_path):
    """The log of a recorder that died three quarters into the run."""
    whole = excitation.read_bytes()
    file = tmp_path / "cut.mcap"
    file.write_bytes(whole[: 3 * len(whole) // 4])
    return file


def test_a_log_that_is_cut_off_is_said_and_stands_in_the_parameter_file(cut_off, tmp_path, capsys):
    output = tmp_path / "own.toml"
    assert softloop("identify", cut_off, "--method", "ls", "--output", output) == 0
    lines = capsys.readouterr().err.splitlines()
    assert any(line.startswith("softloop: cut.mcap: the file was not finished or is cut off") for line in lines)
    assert any("not valid evidence: " in line and "the log file is damaged or unfinished" in line for line in lines)
    for run in load_parameters(output).evidence.runs:
        assert any("cut off" in problem for problem in run.log_problems)
        assert "the log file is damaged or unfinished" in run.evidence_problems


def test_of_a_whole_log_nothing_is_said(excitation, capsys):
    assert softloop("identify", excitation, "--method", "ls") == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert re.search(r"^fitted in \d+\.\d s$", said.out, re.M)


def test_files_of_one_name_are_told_apart_by_their_folders():
    files = [Path("a/x/bend.csv"), Path("b/x/bend.csv"), Path("a/x/other.csv"), Path("a/x/bend.csv")]
    assert labels(files, ending=False) == ["a/x/bend", "b/x/bend", "other", "a/x/bend (2)"]
    assert labels([Path("p/fast"), Path("q/fast")], ending=True) == ["p/fast", "q/fast"]
    assert labels([Path("p/one"), Path("p/Data2")], ending=True, taken=("Data1", "Data2")) == ["one", "p/Data2"]


def test_no_file_hides_another_and_the_training_data_are_not_unseen(tmp_path, capsys):
    files = [bend(tmp_path / folder / "bend.csv", seed) for folder, seed in (("a", 1), ("b", 2), ("c", 1))]
    csv = [f"--csv={file}" for file in files]
    assert softloop("identify", *csv, *MAP, "--method", "ls") == 0
    said = capsys.readouterr().out
    assert "a/bend (trained) " in said
    assert "b/bend (unseen) " in said
    assert "c/bend (trained on) " in said


def test_ventings_of_one_name_too(tmp_path, capsys):
    files = [tank(tmp_path / folder / "tank.csv", kpa) for folder, kpa in (("a", 80.0), ("b", 40.0), ("c", 80.0))]
    assert softloop("identify", "--venting", *(f"--csv={file}" for file in files), *VENT_MAP, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert list(answer["train"]) == ["a/tank"]
    assert list(answer["validate"]) == ["b/tank", "c/tank"]
    assert answer["trained_on"] == ["c/tank"]


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (("--venting", "--csv", "x.csv", "--output", "x.toml"), "identify --venting has no use for --output; leave it out"),
        (("--venting", "--csv", "x.csv", "--figure", "x.png", "--method", "oe"), "no use for --method, --figure"),
        (("RUN", "--venting", "--csv", "x.csv"), "identify --venting has no use for RUN..."),
        (("--venting", *VENT_MAP), "identify --venting needs --csv FILE"),
        (("RUN", "--train", "1"), "--train goes with --venting"),
        (("RUN", "--map", "time=t"), "--map goes with --csv"),
        (("--csv", "x.csv", *MAP, "--map", "time=u"), "'time' is given twice"),
        (("RUN", "--select", "--output", "x.toml"), "identify --select compares orders, and has no use for --output"),
    ],
)
def test_an_option_that_would_be_ignored_is_refused(capsys, arguments, fault):
    assert softloop("identify", *arguments) == 2
    error = capsys.readouterr().err
    assert fault in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("option", "target", "fault"),
    [
        ("--figure", "nodir/x.png", "there is no folder"),
        ("--figure", "x.xyz", "the ending says the format, one of: .svg, .pdf, .png"),
        ("--figure", ".", "is a folder"),
        ("--output", "nodir/x.toml", "there is no folder"),
    ],
)
def test_where_nothing_can_be_written_is_said_before_the_fit(tmp_path, monkeypatch, capsys, option, target, fault):
    monkeypatch.setattr(identify, "fitted", None)
    file = bend(tmp_path / "bend.csv")
    assert softloop("identify", "--csv", file, *MAP, option, tmp_path / target) == 2
    error = capsys.readouterr().err
    assert fault in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("rows", [0, 1, 99])
def test_a_venting_of_few_rows_is_one_line(tmp_path, capsys, rows):
    file = save(tmp_path / "tank.csv", "t,p", np.column_stack([np.arange(rows), 5.0 - 0.01 * np.arange(rows)]))
    assert softloop("identify", "--venting", "--csv", file, *VENT_MAP) == 2
    assert f"tank: {rows} samples; 100 or more of venting are needed" in capsys.readouterr().err


def test_strange_units_and_a_poor_fit_are_hinted_at(tmp_path, capsys):
    file = bend(tmp_path / "bend.csv", edit=lambda rows: np.column_stack([rows[:, 0], rows[:, 1], np.sin(1e4 * rows[:, 0])]))
    mapped = ("--map", "time=t*1000", "--map", "pressure=p*0.001", "--map", "angle=y*0.1")
    assert softloop("identify", "--csv", file, *mapped, "--method", "ls", "--json") == 0
    said = capsys.readouterr()
    hints = json.loads(said.out)["hints"]
    assert [f"softloop: {hint}" for hint in hints] == said.err.splitlines()
    assert hints[0].startswith("bend: a sample every 5 s and a range of pressure of 0.1")
    assert "and a range of the angle of 0.2 deg: are the units s, kPa and deg?" in hints[0]
    assert re.match(r"bend: a fit of -?\d+\.\d\d % where it was trained: ", hints[1])
    assert len(hints) == 2


def test_no_table_is_cut_at_80_columns(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    name = "a_long_name_for_a_run_that_bends_and_bends_again"
    files = [bend(tmp_path / folder / f"{name}.csv", seed) for folder, seed in (("first", 1), ("second", 2))]
    assert softloop("identify", *(f"--csv={file}" for file in files), *MAP, "--method", "ls") == 0
    out = capsys.readouterr().out
    assert "\N{HORIZONTAL ELLIPSIS}" not in out
    assert " to " in next(line for line in out.splitlines() if " a0 " in line)
