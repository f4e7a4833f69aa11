"""The reproduction: its page from small numbers, and one whole small reproduction by its command."""

import json
import re
import subprocess
import sys

import pytest

from softloop.deploy.reproduce import Wanted, run_reproduce
from softloop.offline.reproduction_page import LogEntry, Picture, Row, Section, TableOf, figures, number, page_of
from softloop.wire.errors import BadConfig, Unavailable


def test_every_row_of_the_page_names_its_source():
    table = TableOf(
        "Fits", ("model", "Data2"), (Row(("ours <b>", "92.1"), "a/run.mcap"), Row(("paper", "92.9"), "text", link=False))
    )
    section = Section("One", "lead", [table, Picture("drawn", b"<svg/>")])
    page = page_of("Title", "lead", [section], [LogEntry("a/run.mcap", "0" * 64, "yes")], {"took": "3 s"})
    assert "ours &lt;b&gt;" in page
    assert '<a href="a/run.mcap">a/run.mcap</a>' in page
    assert re.search(r"92\.9</td><td class=remark>text</td>", page)
    assert "0" * 64 in page


def test_what_has_no_number_is_a_dash():
    assert number(None) == figures(None) == "\N{EN DASH}"
    assert (number(1.005, 1), figures(0.000123456)) == ("1.0", "0.00012346")


def test_a_folder_that_holds_something_is_refused(tmp_path):
    (tmp_path / "old.txt").write_text("")
    with pytest.raises(Unavailable, match="is not empty"):
        run_reproduce(Wanted(tmp_path, "batch", 0, "0:1", quiet=True))
    with pytest.raises(Unavailable, match="is a file, and a folder"):
        run_reproduce(Wanted(tmp_path / "old.txt", "batch", 0, "0:1", quiet=True))
    with pytest.raises(BadConfig, match="seeds"):
        run_reproduce(Wanted(tmp_path / "new", "batch", 0, "2:1", quiet=True))
    assert not (tmp_path / "new").exists()


@pytest.mark.long
def test_a_small_reproduction_leaves_a_page_with_every_table_and_figure(tmp_path):
    words = ("reproduce", "--out", "r", "--rigs", "1", "--seeds", "0:1")
    command = [sys.executable, "-m", "softloop.deploy.cli", *words]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=900, check=False, stdin=subprocess.DEVNULL
    )
    assert done.returncode == 0, done.stderr
    page, numbers = (tmp_path / "r" / "reproduce.html").read_text(), json.loads((tmp_path / "r" / "reproduce.json").read_text())
    for words in (
        "Table 1 by",
        "Figs. 2a and 2b",
        "Figs. 2c and 2d",
        "Fig. 4",
        "Fig. 6",
        "Fig. 7",
        "Orders",
        "Coverage",
        "Another rig",
    ):
        assert words in page
    for printed in ("92.8772", "90.8123", "4.36", "0.82", "3.67", "4.75", "1.56", "5.27", "89.973"):
        assert printed in page
    logs = set(re.findall(r'href="([^"]+\.mcap)"', page))
    assert len(logs) == 2 + 3 + 8 + 2 + 16
    assert all((tmp_path / "r" / log).is_file() for log in logs)
    assert page.count("<figure>") == 5
    assert set(numbers) >= {"pressure", "identification", "orders", "valves", "tracking", "another_rig", "fits_over_rigs"}
    assert "identifying" in done.stderr  # progress, also where there is no terminal
