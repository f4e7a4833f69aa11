import json
import shutil

import numpy as np
import pytest
from tests.offline import synthetic

from softloop.deploy import cli
from softloop.offline.log import open_log
from softloop.offline.run_log import find_log, open_run
from softloop.wire.errors import BadFile
from softloop.wire.log_parts import account_of, next_part, parts_of


@pytest.fixture
def made():
    return list(synthetic.messages(2.0))


@pytest.fixture
def run(tmp_path, made):
    """A run whose recorder was killed after a third, and came back when half was over."""
    folder = tmp_path / "run"
    folder.mkdir()
    third, half = len(made) // 3, len(made) // 2
    synthetic.write_log(folder / "run.mcap", made[:third], finish=False)
    synthetic.write_log(folder / "run-2.mcap", made[half:])
    return folder


def test_parts_go_by_number_and_a_new_one_comes_after_the_last(tmp_path):
    first = tmp_path / "run.mcap"
    assert next_part(first) == first
    for name in ("run.mcap", "run-2.mcap", "run-10.mcap", "run-x.mcap", "other-2.mcap", "run-1.mcap"):
        (tmp_path / name).touch()
    assert [p.name for p in parts_of(first)] == ["run.mcap", "run-2.mcap", "run-10.mcap"]
    assert next_part(first).name == "run-11.mcap"
    assert [account_of(p).name for p in parts_of(first)] == ["recorder.json", "recorder-2.json", "recorder-10.json"]


def test_a_first_part_that_is_gone_is_not_written_over(tmp_path):
    (tmp_path / "run-2.mcap").touch()
    assert next_part(tmp_path / "run.mcap").name == "run-3.mcap"


def test_all_parts_are_read_as_one(run, made, tmp_path):
    whole = open_log(synthetic.write_log(tmp_path / "whole.mcap", made))
    log = open_run(run)
    seqs = log["cycle"]["seq"].tolist()
    assert seqs[0] == 1
    assert seqs[-1] == whole["cycle"]["seq"][-1]
    assert np.isin(log["cycle"]["seq"], whole["cycle"]["seq"]).all()
    assert log.origin == whole.origin
    assert set(log.attachments) == set(whole.attachments)
    assert log.problems[0].startswith("run.mcap: the file was not finished")
    assert log.finished
    assert len(open_run(run / "run-2.mcap")["cycle"]) < len(seqs)


def test_two_logs_that_are_no_parts_of_each_other_are_still_refused(run):
    shutil.copy(run / "run.mcap", run / "other.mcap")
    with pytest.raises(BadFile, match=r"holds one \.mcap log; here: other\.mcap, run\.mcap"):
        find_log(run)


def test_check_says_each_part_and_the_gap_between_them(run, capsys):
    assert cli._run(["log", "check", str(run)]) == 1
    said = capsys.readouterr().out
    assert "2 parts: the recorder was started again" in said
    assert "run.mcap: not whole" in said
    assert "run-2.mcap: whole" in said
    assert "loss window" in said
    assert cli._run(["log", "check", str(run), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert [part["whole"] for part in found["parts"]] == [False, True]
    assert found["missing"] > 0
    assert {gap["topic"] for gap in found["gaps"]} >= {"cycle", "truth", "pressure"}


def test_repair_joins_the_parts(run, capsys):
    before = open_run(run)
    assert cli._run(["log", "repair", str(run)]) == 0
    assert "from 2 parts" in capsys.readouterr().out
    assert sorted(p.name for p in run.iterdir()) == ["run-2.mcap.damaged", "run.mcap", "run.mcap.damaged"]
    good = open_log(run / "run.mcap")
    assert good.problems == []
    assert {name: len(r) for name, r in good.channels.items()} == {name: len(r) for name, r in before.channels.items()}
    assert all(np.array_equal(good[name], before[name]) for name in good.channels)
    assert all(np.array_equal(good.can[key], before.can[key]) for key in before.can)


def test_a_part_that_is_no_log_at_all_is_said_and_left_out(run):
    (run / "run-3.mcap").write_bytes(b"")
    log = open_run(run)
    assert any("run-3.mcap" in problem and "not an MCAP file" in problem for problem in log.problems)
    assert not log.finished
    assert cli._run(["log", "repair", str(run), "-o", str(run / "good.mcap")]) == 0
    assert len(open_log(run / "good.mcap")["cycle"]) == len(log["cycle"])
