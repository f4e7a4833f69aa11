"""Long counts are kept as they go, and an interrupted one shows what there is and says how much that is."""

import json

import numpy as np
import pytest

from softloop.deploy.fits import fits
from softloop.deploy.tally import count, go_over
from softloop.offline.identification.coverage import RIG_METHODS, RigTally
from softloop.offline.identification.structure import PAPER
from softloop.wire.errors import BadConfig, BadFile, Interrupted


class Sum:
    """Adds seeds up, each in two steps; Ctrl-C comes in the rig of seed `until`."""

    steps, block = 2, 3

    def __init__(self, until=-1):
        self.until, self.seeds = until, []

    @property
    def rigs(self):
        return len(self.seeds)

    def add(self, seed, step):
        step(0)
        if seed == self.until:
            raise KeyboardInterrupt
        step(1)
        self.seeds.append(seed)

    def counted(self):
        return {"rigs": self.rigs, "sum": sum(self.seeds)}


def test_progress_goes_up_to_its_end_and_every_block_is_kept():
    tally, seen, kept = Sum(), [], []
    go_over(tally, range(5, 12), lambda done, total: seen.append((done, total)), lambda: kept.append(tally.rigs))
    assert seen == [(done, 14) for done in range(15)]
    assert kept == [3, 6]


def test_what_is_counted_stands_in_the_file_and_on_the_screen(tmp_path, capsys):
    count(Sum(), range(4), "adding", {"what": "seeds"}, tmp_path / "sum.json", print, as_json=True)
    answer = {"what": "seeds", "rigs": 4, "sum": 6}
    assert json.loads(capsys.readouterr().out) == json.loads((tmp_path / "sum.json").read_text()) == answer
    assert [path.name for path in tmp_path.iterdir()] == ["sum.json"]


@pytest.mark.parametrize(("until", "rigs"), [(1, 1), (7, 7), (0, 0)])
def test_an_interrupted_count_shows_and_keeps_what_there_is(tmp_path, until, rigs):
    shown, file = [], tmp_path / "sum.json"
    with pytest.raises(Interrupted, match=f"after {rigs} of 10 rigs"):
        count(Sum(until), range(10), "adding", {}, file, shown.append, as_json=False)
    expected = [{"rigs": rigs, "sum": sum(range(rigs))}] if rigs else []
    assert shown == expected
    assert ([json.loads(file.read_text())] if file.exists() else []) == expected


def test_a_count_that_is_killed_leaves_its_last_block(tmp_path):
    class Killed(Sum):
        def add(self, seed, step):
            if seed == 8:
                raise SystemExit
            super().add(seed, step)

    file = tmp_path / "sum.json"
    with pytest.raises(SystemExit):
        count(Killed(), range(10), "adding", {}, file, print, as_json=False)
    assert json.loads(file.read_text())["rigs"] == 6


def test_a_file_that_cannot_be_written_is_said(tmp_path):
    (tmp_path / "folder").mkdir()
    for output, words in ((tmp_path / "none" / "sum.json", "there is no folder"), (tmp_path / "folder", "cannot be written")):
        with pytest.raises(BadFile, match=words):
            count(Sum(), range(4), "adding", {}, output, print, as_json=False)


def test_fits_of_a_rig_are_counted(capsys):
    assert fits("3:4", 1, 1, None, as_json=True) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["rigs"], answer["hysteresis"], answer["creep"]) == (1, 1, 1)
    for data in ("Data2", "Data3"):
        bare, memory = (answer["models"][key][data] for key in ("oe", "memory"))
        assert 85.0 < bare["worst"] < memory["worst"] == memory["median"] < 100.0
        assert memory["worst_seed"] == 3
    with pytest.raises(BadConfig, match="FIRST:END"):
        fits("3:3", None, None, None, as_json=True)


def test_experiments_of_a_rig_are_counted():
    tally, steps = RigTally(repeats=6), []
    tally.add(2, steps.append)
    counted = tally.counted()
    assert steps == list(range(6))
    assert set(counted["methods"]) == {*RIG_METHODS, "between"}
    for rows in counted["methods"].values():
        assert set(rows) == set(PAPER.names)
        assert all(0.0 <= row[key] <= 1.0 for row in rows.values() for key in ("mean_held", "scatter_held"))
    errors = {m: np.mean([row["error_percent"] for row in rows.values()]) for m, rows in counted["methods"].items()}
    assert errors["white"] < errors["bootstrap"]
