"""Pictures and page: complete, self-contained, and made of any log."""

import base64
import html.parser
import re
import shutil

import pytest
import synthetic

from softloop.offline import figures
from softloop.offline.log import open_log
from softloop.offline.report import make_report
from softloop.offline.summary import MEANINGS, summarise
from softloop.offline.vector import as_bytes
from softloop.wire.errors import BadFile


class Page(html.parser.HTMLParser):
    """Tags and addresses of a page; fails on tags that do not match."""

    VOID = ("meta", "img", "br")

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.addresses = [], [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.addresses += [v for k, v in attributes if k in ("src", "href", "srcset", "action", "data", "poster")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def run(tmp_path_factory, long_run):
    folder = tmp_path_factory.mktemp("run")
    shutil.copy(long_run / "run.mcap", folder)
    make_report(folder)
    return folder


@pytest.fixture(scope="module")
def text(run):
    return (run / "report.html").read_text()


def test_the_page_and_its_pictures_are_there(run, text):
    names = {p.name for p in run.iterdir()}
    pictures = {f"{name}.{ending}" for name, _, _ in figures.PICTURES for ending in ("svg", "pdf", "png")}
    assert names == {"run.mcap", "report.html", "summary.json", *pictures}
    page = Page(text)
    assert page.tags.count("img") == len(figures.PICTURES)
    for name, address in zip([p[0] for p in figures.PICTURES], page.addresses, strict=True):
        assert base64.b64decode(address.removeprefix("data:image/svg+xml;base64,")) == (run / f"{name}.svg").read_bytes()
        assert (run / f"{name}.svg").read_bytes().startswith(b"<?xml")
        assert (run / f"{name}.pdf").read_bytes().startswith(b"%PDF")


def test_the_page_asks_for_nothing_from_anywhere(text):
    outside = re.sub(r"data:image/svg\+xml;base64,[A-Za-z0-9+/=]+", "", text)
    assert not re.search(r"https?:|//[a-z]|@import|url\(|<script|<link", outside)
    assert "default-src 'none'" in text


def test_the_page_shows_figures_and_provenance(text):
    assert "maximum dynamic error" in text
    assert "abc" in text
    assert "[controller]" in text
    assert all(f">{key}<" in text for key in MEANINGS)
    assert "Valid evidence" in text


def test_text_of_the_log_cannot_become_markup(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "DPI", 40)
    monkeypatch.setattr(synthetic, "BENCH_TOML", b'name = "<script>alert(1)</script>"\n[controller]\nlaw = "<b>"\n')
    synthetic.write_log(tmp_path / "run.mcap", list(synthetic.messages(0.5)))
    page = make_report(tmp_path).read_text()
    assert "<script>" not in page
    assert "<b>:" not in page
    assert "&lt;script&gt;" in page


def test_the_same_log_gives_the_same_picture(run):
    log = open_log(run / "run.mcap")
    summary = summarise(log)
    assert as_bytes(figures.tracking(log, summary), "svg") == (run / "tracking.svg").read_bytes()


LOGS = {
    "empty": [],
    "no plant": [m for m in synthetic.messages(0.5) if m[0] != "truth"],
    "cycles only": [m for m in synthetic.messages(0.5) if m[0] == "cycle"],
    "no cycles": [m for m in synthetic.messages(0.5) if m[0] != "cycle"],
    "never tracked": [(c, k, m._replace(phase=0) if c == "cycle" else m) for c, k, m in synthetic.messages(0.5)],
    "one tick": [m for m in synthetic.messages(0.5) if m[0] == "cycle"][-1:],
}


@pytest.mark.parametrize("name", LOGS)
def test_any_log_gives_a_report(tmp_path, monkeypatch, name):
    monkeypatch.setattr(figures, "DPI", 40)
    synthetic.write_log(tmp_path / "run.mcap", LOGS[name])
    Page(make_report(tmp_path).read_text())


def test_a_damaged_log_gives_a_report_that_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "DPI", 40)
    file = synthetic.write_log(tmp_path / "run.mcap", list(synthetic.messages(4.0)))
    file.write_bytes(file.read_bytes()[:-30_000])
    text = make_report(tmp_path).read_text()
    assert "Not valid evidence" in text
    assert "Problems of the log" in text


def test_the_error_panel_has_the_papers_figures_and_all_errors_in_sight(run):
    log = open_log(run / "run.mcap")
    summary = summarise(log)
    axis = figures.tracking(log, summary).axes[2]
    levels = {line.get_ydata()[0] for line in axis.lines if line.get_linestyle() == "--"}
    assert levels == {4.36, -4.36, 4.75, -4.75, 0.82, -0.82}
    low, high = axis.get_ylim()
    assert low < -4.75
    assert high > 4.75


def test_no_log_is_said(tmp_path):
    with pytest.raises(BadFile, match="here: none"):
        make_report(tmp_path)
