"""What `softloop identify` says beside its answer, and what it refuses."""

import pytest
from test_command import softloop

from softloop.dynamics.parameters import load_parameters


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
    assert capsys.readouterr().err == ""
