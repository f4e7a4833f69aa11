"""`softloop plot`: any fields of a log against time, one panel per unit, as a vector picture."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from softloop.offline.figures import BLACK, BLUE, GREEN, ORANGE, RED, SKY, STYLE, make_figure
from softloop.offline.log import Log
from softloop.wire.errors import BadConfig, BadFile

COLORS = (BLUE, ORANGE, GREEN, RED, SKY, BLACK)
POINTS_MAX = 20_000  # of one curve in the picture; more cannot be seen
PANEL_IN = 2.3
# Endings of field names, the longer ones first, and how the unit is written.
_UNITS = {
    "_deg_s3": "°/s³", "_deg_s2": "°/s²", "_deg_s": "°/s", "_kpa_s": "kPa/s", "_mm2": "mm²", "_deg": "°", "_kpa": "kPa",
    "_ma": "mA", "_ns": "ms", "_us": "µs", "_k": "K",
}  # fmt: skip
_NAME = re.compile(r"^([a-z]+)\.([a-z0-9_]+)(?:\[(\d+)\])?$")


@dataclass(frozen=True)
class Curve:
    """One curve: its name as asked for, its unit as it is written, times (n,) in s since the start of the log, values (n,)."""

    name: str
    unit: str
    time_s: NDArray[np.float64]
    values: NDArray[np.float64]


def unit_of(field: str) -> str:
    """The unit in a field's name; empty when it has none. Nanoseconds are shown as ms."""
    return next((unit for ending, unit in _UNITS.items() if field.endswith(ending)), "")


def curve(log: Log, name: str, first_s: float = -np.inf, last_s: float = np.inf) -> Curve:
    """The curve called `channel.field` or `channel.field[i]`, within a span of time.

    Raises:
        BadConfig: the name cannot be one, or the channel has no such field.
        BadFile: there is nothing to draw.
    """
    match = _NAME.match(name)
    if match is None:
        raise BadConfig(f"'{name}': a curve is named CHANNEL.FIELD, or CHANNEL.FIELD[I] for one of an array")
    channel, field, index = match[1], match[2], match[3]
    records = log[channel]
    fields = records.dtype.names or ()
    if field not in fields:
        raise BadConfig(f"channel '{channel}' has no field '{field}'; it has: {', '.join(fields)}")
    if not len(records):
        raise BadFile(f"{log.path}: nothing was logged on channel '{channel}'")
    values = _one_column(name, records[field], index)
    time_s = (records["stamp_ns"] - start_ns(log)) * 1e-9
    inside = (time_s >= first_s) & (time_s <= last_s)
    if not inside.any():
        span = f"{time_s[0]:.3f} to {time_s[-1]:.3f} s"
        raise BadFile(f"{log.path}: '{name}' has nothing between {first_s:g} and {last_s:g} s; it spans {span}")
    return Curve(name, unit_of(field), time_s[inside], values[inside] * (1e-6 if field.endswith("_ns") else 1.0))


def _one_column(name: str, values: Any, index: str | None) -> NDArray[np.float64]:
    length = values.shape[1] if values.ndim == 2 else 0
    if bool(length) != (index is not None) or (index is not None and int(index) >= length):
        raise BadConfig(f"'{name}': " + (f"an array; name one of [0] to [{length - 1}]" if length else "not an array"))
    column = values[:, int(index)] if index is not None else values
    return np.asarray(column, np.float64)


def start_ns(log: Log) -> int:
    """The rig clock at the start of the log; without an origin, its earliest stamp."""
    if log.origin is not None:
        return log.origin.clock_ns
    return min((int(r["stamp_ns"].min()) for r in log.channels.values() if len(r)), default=0)


def thinned(curve: Curve, points: int = POINTS_MAX) -> Curve:
    """The curve with at most about `points` points: of each stretch its lowest and its highest, so that no spike is lost."""
    n = len(curve.values)
    if n <= points:
        return curve
    stretch = -(-2 * n // points)
    whole = n // stretch * stretch
    rows = curve.values[:whole].reshape(-1, stretch)
    filled = np.where(np.isnan(rows), np.inf, rows), np.where(np.isnan(rows), -np.inf, rows)
    picked = np.sort(np.stack([filled[0].argmin(1), filled[1].argmax(1)], 1), axis=1) + np.arange(len(rows))[:, None] * stretch
    kept = np.unique(np.concatenate([picked.ravel(), np.arange(whole, n)]))
    return Curve(curve.name, curve.unit, curve.time_s[kept], curve.values[kept])


def plot(curves: list[Curve], title: str = "") -> Figure:
    """Panels one above the other, one for each unit, over one axis of time."""
    panels: dict[str, list[Curve]] = {}
    for one in curves:
        panels.setdefault(one.unit, []).append(one)
    with mpl.rc_context(STYLE):
        figure, axes = make_figure(1.0 + PANEL_IN * len(panels), len(panels), sharex=True)
        for axis, (unit, here) in zip(axes, panels.items(), strict=True):
            _draw(axis, unit, here)
        axes[-1].set_xlabel("time since the start of the log (s)")
        axes[0].set_title(title)
        figure.align_ylabels(axes)
    return figure


def _draw(axis: Axes, unit: str, curves: list[Curve]) -> None:
    for number, one in enumerate(curves):
        shown = thinned(one)
        style: Any = ("-", (0, (4, 2)), (0, (1, 1.5)))[number // len(COLORS) % 3]
        axis.plot(shown.time_s, shown.values, color=COLORS[number % len(COLORS)], linestyle=style, linewidth=1.0, label=one.name)
    axis.set_ylabel(unit or "value")
    columns = 1 if len(curves) > 3 else len(curves)
    axis.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=max(columns, 3), borderaxespad=0.2, handlelength=1.6)
