from pathlib import Path

import numpy as np
import pytest

from softloop.offline.identification.csv_map import parse_map, read_csv, rising
from softloop.wire.errors import BadConfig, BadFile

MAP = ["time=t_ms*0.001", "pressure=p1,p2*100", "angle=bend"]


def written(path, rows=60, edit=lambda lines: lines):
    lines = ["t_ms,p1,p2,bend,note"]
    lines += [f"{40 * i},{i % 7},{0.01 * (i % 5)},{np.sin(i):.4f},x" for i in range(rows)]
    path.write_text("\n".join(edit(lines)) + "\n")
    return path


def test_columns_are_taken_as_mapped_with_their_factors(tmp_path):
    series = read_csv(written(tmp_path / "run.csv"), parse_map(MAP))
    assert series.name == "run"
    assert series.time_s[1] == pytest.approx(0.04)
    assert series.pressure_kpa.shape == (60, 2)
    assert series.pressure_kpa[4].tolist() == pytest.approx([4.0, 4.0])


@pytest.mark.parametrize(
    ("entries", "fault"),
    [
        (["time=t"], "nothing given for pressure, angle"),
        (["speed=t"], "KEY one of time, pressure, angle"),
        (["time"], "KEY=COLUMN"),
        (["time=a,b"], "only 'pressure'"),
        (["time=a*x"], "'x' is no number"),
        (["time=a*inf"], "a factor must be a finite number other than 0"),
        (["time=a*0"], "a factor must be a finite number other than 0"),
        (["time=a", "pressure=p", "time=b"], "'time' is given twice; give it once$"),
        (["pressure=p", "pressure=q"], "give it once, several columns by commas"),
    ],
)
def test_a_bad_map_is_one_clear_line(entries, fault):
    with pytest.raises(BadConfig, match=fault):
        parse_map(entries)


@pytest.mark.parametrize(
    ("edit", "fault"),
    [
        (lambda lines: lines[:20], "19 rows"),
        (lambda lines: [*lines[:5], "1,2", *lines[6:]], "row 6 has 2 fields where the header has 5"),
        (lambda lines: [*lines[:5], "160,a,0,1,x", *lines[6:]], "row 6 holds no number"),
        (lambda lines: [*lines[:9], lines[7], *lines[10:]], "row 10: time must rise"),
        (lambda lines: [*lines[:5], "160,1e300,0,1,x", *lines[6:]], r"row 6 holds 1e\+300, which nothing measures"),
        (lambda lines: [*lines[:40], *[lines[39]] * 20], "39 rows"),
        (lambda lines: [*lines[:9], *lines[31:]], "row 10: a gap of 0.92 s before it, where rows are usually 0.04 s apart"),
        (lambda lines: [*lines[:60], "1e10,1,0,1,x"], r"row 61: a gap of 1e\+07 s"),
        (lambda lines: [x.replace("bend", "angle") for x in lines], "no column bend; there are: t_ms, p1, p2, angle, note"),
        (lambda lines: lines[:1] + [f"{i},1,{i},{i},x" for i in range(60)], "never changes"),
    ],
)
def test_a_bad_file_is_one_clear_line(tmp_path, edit, fault):
    with pytest.raises(BadFile, match=fault):
        read_csv(written(tmp_path / "run.csv", edit=edit), parse_map(MAP))


def test_no_file_and_no_text_are_said(tmp_path):
    with pytest.raises(BadFile, match="cannot be read"):
        read_csv(tmp_path / "none.csv", parse_map(MAP))
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(BadFile, match="not a CSV file"):
        read_csv(tmp_path / "bytes.csv", parse_map(MAP))


def test_rows_that_repeat_a_time_are_left_out_and_counted(tmp_path):
    said = []
    path = written(tmp_path / "run.csv", edit=lambda lines: [*lines[:9], lines[8], lines[8], *lines[9:]])
    series = read_csv(path, parse_map(MAP), said.append)
    assert len(series.time_s) == 60
    assert said == [f"{path}: rows that repeat the time of the row before, left out: 2 (the first is row 10)"]


@pytest.mark.parametrize(
    ("usual_s", "gap_s", "taken"),
    [(0.01, 0.2, True), (0.01, 0.21, False), (0.2, 0.99, True), (0.2, 1.05, False), (0.5, 1.5, True), (0.5, 1.6, False)],
)
def test_what_is_a_gap_depends_on_the_usual_step(usual_s, gap_s, taken):
    time_s = np.concatenate([np.arange(30) * usual_s, 29 * usual_s + gap_s + np.arange(30) * usual_s]) - 1e-12
    if taken:
        assert len(rising(Path("x.csv"), time_s, print)) == 60
        return
    with pytest.raises(BadFile, match=r"x\.csv: row 32: a gap"):
        rising(Path("x.csv"), time_s, print)
