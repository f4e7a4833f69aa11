"""Series from CSV files measured elsewhere: which column is what is said by a map.

A map names columns for `time`, `pressure` and `angle`. Several pressures are joined by commas, each then has a gain of its own.
A column may be brought to s, kPa or deg by a factor: `time=t_ms*0.001`.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softloop.offline.identification.series import LEAST_SAMPLES, Series
from softloop.offline.identification.venting import Vent, vent_of
from softloop.wire.errors import BadConfig, BadFile

Floats = NDArray[np.float64]
NEEDED = ("time", "pressure", "angle")
# A step between rows is a gap when it is longer than so many usual ones, or than GAP_S; slow series may miss a sample or two.
GAP_STEPS, GAP_S, GAP_LEAST_STEPS = 20.0, 1.0, 3.0
BELIEVED = 1e15  # in whatever unit; squares of more do not add up
ROUNDING = 1e-6  # of times as they are written


@dataclass(frozen=True)
class Column:
    """A column's name and the factor that brings it to s, kPa or deg."""

    name: str
    factor: float = 1.0


Map = dict[str, tuple[Column, ...]]
Say = Callable[[str], None]


def unheard(text: str) -> None:
    """For those who do not want to know which rows were left out."""


def parse_map(entries: Sequence[str], needed: Sequence[str] = NEEDED, optional: Sequence[str] = ()) -> Map:
    """`["time=t_s", "pressure=P1_kPa,P2_kPa", ...]` as a map. Raises BadConfig with one line."""
    found: Map = {}
    for entry in entries:
        key, equals, columns = entry.partition("=")
        if not equals or key not in (*needed, *optional) or not columns:
            raise BadConfig(f"--map {entry}: must be KEY=COLUMN with KEY one of {', '.join((*needed, *optional))}")
        if key in found:
            raise BadConfig(
                f"--map {entry}: '{key}' is given twice; give it once{', several columns by commas' * (key == 'pressure')}"
            )
        found[key] = tuple(_column(text, entry) for text in columns.split(","))
        if key != "pressure" and len(found[key]) != 1:
            raise BadConfig(f"--map {entry}: only 'pressure' may have several columns")
    missing = [key for key in needed if key not in found]
    if missing:
        raise BadConfig(f"--map: nothing given for {', '.join(missing)}; such as --map {missing[0]}=COLUMN")
    return found


def _column(text: str, entry: str) -> Column:
    name, star, factor = text.partition("*")
    try:
        column = Column(name.strip(), float(factor) if star else 1.0)
    except ValueError:
        raise BadConfig(f"--map {entry}: '{factor}' is no number") from None
    if not np.isfinite(column.factor) or column.factor == 0.0:
        raise BadConfig(f"--map {entry}: a factor must be a finite number other than 0, such as 0.001; not {factor}")
    return column


def read_csv(path: Path, columns: Map, say: Say = unheard) -> Series:
    """One file as a series; `say` hears of rows that are left out. Raises BadFile: one line with file, row and fault."""
    table = _wanted(path, columns)

    def taken(key: str) -> list[Floats]:
        return [table[c.name] * c.factor for c in columns[key]]

    time_s, pressure, angle = taken("time")[0], np.stack(taken("pressure"), axis=1), taken("angle")[0]
    _check_numbers(path, np.column_stack([time_s, pressure, angle]))
    kept = rising(path, time_s, say)
    series = Series(path.stem, time_s[kept], pressure[kept], angle[kept])
    _check(path, series)
    return series


def read_columns(path: Path, columns: Map) -> dict[str, Floats]:
    """The first column of each key, (n,). Raises BadFile as `read_csv` does."""
    table = _wanted(path, columns)
    taken = {key: table[group[0].name] * group[0].factor for key, group in columns.items()}
    _check_numbers(path, np.column_stack(list(taken.values())))
    return taken


def read_vent(path: Path, columns: Map, say: Say = unheard) -> Vent:
    """One file as a venting. Says and raises as `read_csv` does."""
    taken = read_columns(path, columns)
    kept = rising(path, taken["time"], say)
    of = {key: values[kept] for key, values in taken.items()}
    return vent_of(path.stem, of["time"], of["pressure"], of.get("input"))


def rising(path: Path, time_s: Floats, say: Say) -> NDArray[np.int64]:
    """Which rows to take: those that repeat the time of the row before are left out. Raises BadFile on a fall or a gap."""
    steps = np.diff(time_s)
    back = np.flatnonzero(steps < 0)
    if len(back):
        raise BadFile(f"{path}: row {back[0] + 3}: time must rise from row to row")
    kept = np.flatnonzero(np.diff(time_s, prepend=-np.inf) > 0)
    if len(kept) < len(time_s):
        count, first = len(time_s) - len(kept), int(np.flatnonzero(steps == 0)[0]) + 3
        say(f"{path}: rows that repeat the time of the row before, left out: {count} (the first is row {first})")
    _check_gap(path, time_s[kept], kept + 2)
    return kept


def _check_gap(path: Path, time_s: Floats, rows: NDArray[np.int64]) -> None:
    """A simulation steps from row to row: over a gap it knows no pressure, and a few long steps do not stay stable."""
    steps = np.diff(time_s)
    if not len(steps):
        return
    usual, worst = float(np.median(steps)), int(np.argmax(steps))
    longest = min(GAP_STEPS * usual, max(GAP_S, GAP_LEAST_STEPS * usual))
    if steps[worst] > longest * (1.0 + ROUNDING):
        raise BadFile(
            f"{path}: row {rows[worst + 1]}: a gap of {steps[worst]:.4g} s before it, where rows are usually {usual:.4g} s "
            f"apart; cut the file there, and give the parts as files of their own"
        )


def _wanted(path: Path, columns: Map) -> dict[str, Floats]:
    """All columns, among them those of the map."""
    table = _table(path)
    missing = sorted({c.name for group in columns.values() for c in group} - set(table))
    if missing:
        raise BadFile(f"{path}: there is no column {', '.join(missing)}; there are: {', '.join(table)}")
    return table


def _check_numbers(path: Path, values: Floats) -> None:
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise BadFile(f"{path}: row {bad[0] + 2} holds no number where one is needed")
    wild = np.argwhere(np.abs(values) > BELIEVED)
    if len(wild):
        row, column = wild[0].tolist()
        raise BadFile(
            f"{path}: row {row + 2} holds {values[row, column]:.4g}, which nothing measures; check the column, and --map"
        )


def _check(path: Path, series: Series) -> None:
    if len(series.time_s) < LEAST_SAMPLES:
        raise BadFile(f"{path}: {len(series.time_s)} rows; identification needs {LEAST_SAMPLES} or more")
    if not np.ptp(series.angle_deg) or not np.ptp(series.pressure_kpa, axis=0).all():
        raise BadFile(f"{path}: angle or a pressure never changes, which says nothing about the actuator")


def _table(path: Path) -> dict[str, Floats]:
    """Column name -> values (n,); what is not a number becomes NaN."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.reader(file))
    except OSError as error:
        raise BadFile(f"{path}: cannot be read: {error.strerror or error}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise BadFile(f"{path}: not a CSV file in UTF-8: {error}") from None
    if not rows:
        raise BadFile(f"{path}: empty; a header and rows are needed")
    header, body = [name.strip() for name in rows[0]], [row for row in rows[1:] if row]
    for number, row in enumerate(body, 2):
        if len(row) != len(header):
            raise BadFile(f"{path}: row {number} has {len(row)} fields where the header has {len(header)}")
    return {name: np.array([_number(row[i]) for row in body]) for i, name in enumerate(header)}


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")
