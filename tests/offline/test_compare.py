"""Several runs on one page."""

import re
import shutil

import pytest
import synthetic
from test_report import Page

from softloop.deploy.comparing import compare_runs
from softloop.offline.compare import best_of, compare, differences, labels, set_up
from softloop.offline.log import open_log
from softloop.wire.errors import BadConfig, BadFile


@pytest.fixture(scope="module")
def runs(tmp_path_factory, long_run):
    folder = tmp_path_factory.mktemp("runs")
    shutil.copytree(long_run, folder / "first")
    (folder / "second").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "BENCH_TOML", b'name = "other"\n\n[controller]\nlaw = "<pid>"\n')
        synthetic.write_log(folder / "second" / "run.mcap", list(synthetic.messages(8.0, moving=True, seed=2)))
    return [folder / "first", folder / "second"]


def test_the_page_has_figures_pictures_and_what_differs(runs, tmp_path, capsys):
    assert compare_runs(runs, tmp_path / "out") == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "out" / "compare.html")
    names = ("tracking", "errors", "lateness")
    files = {f"compare_{name}.{ending}" for name in names for ending in ("svg", "pdf")}
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"compare.html", *files}
    text = (tmp_path / "out" / "compare.html").read_text()
    assert Page(text).tags.count("img") == 3
    assert "<pid>" not in text
    assert "&lt;pid&gt;" in text
    assert "controller.law" in text
    assert "maximum error, true angle" in text
    assert re.search(r"<b>\d+\.\d+</b>", text)
    assert not re.search(r"https?:|<script|<link", re.sub(r"base64,[A-Za-z0-9+/=]+", "", text))


def test_a_run_beside_itself_differs_in_nothing(runs, tmp_path):
    text = compare([runs[0], runs[0]], tmp_path).read_text()
    assert "Nothing: bench file, parameters, versions and commit are the same." in text
    assert not re.search(r"<b>\d", text)


def test_labels_tell_runs_apart(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "x" / "a").mkdir(parents=True)
    assert labels([tmp_path / "a", tmp_path / "x"]) == ["a", "x"]
    assert labels([tmp_path / "a", tmp_path / "x" / "a"]) == ["a (1)", "a (2)"]
    assert labels([tmp_path / "a" / "run.mcap"]) == ["a"]


def test_the_best_is_the_least_where_there_is_one():
    assert best_of([3.0, 2.0, None]) == 2.0
    assert best_of([2.0, 2.0]) is None
    assert best_of([2.0, None]) is None
    assert best_of([True, False]) is None


def test_set_up_is_flat_and_its_differences_are_found(runs):
    tables = [set_up(open_log(run / "run.mcap")) for run in runs]
    assert tables[0]["controller.law"] == "arc"
    assert ("controller.law", ["arc", "<pid>"]) in differences(tables)
    assert differences([tables[0], tables[0]]) == []


def test_what_cannot_be_compared_is_said(runs, tmp_path):
    with pytest.raises(BadConfig, match="two to 6 runs"):
        compare(runs[:1], tmp_path)
    with pytest.raises(BadFile):
        compare([runs[0], tmp_path / "nowhere"], tmp_path)
    synthetic.write_log(tmp_path / "empty.mcap", [])
    with pytest.raises(BadFile, match="no cycle record"):
        compare([runs[0], tmp_path / "empty.mcap"], tmp_path)
