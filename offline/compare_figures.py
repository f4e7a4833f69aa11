"""The pictures of `softloop compare`: runs over each other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from softloop.offline import metrics
from softloop.offline.figures import BLACK, BLUE, GREEN, ORANGE, RED, SKY, STYLE, make_figure
from softloop.offline.log import Log
from softloop.offline.metrics import Errors
from softloop.offline.plot import Curve, thinned

COLORS = (BLUE, RED, GREEN, ORANGE, SKY, BLACK)
POINTS = 4000
_LATENESS_LEAST_MS = 0.001


@dataclass(frozen=True)
class Shown:
    """A run as it stands in a picture."""

    label: str
    log: Log


def errors_of(log: Log) -> tuple[Errors, str]:
    """The errors of a run and what they are against: the true angle, or the inclinometer where there is no plant."""
    errors = metrics.truth_errors(log)
    return (errors, "true angle") if errors.error_deg.size else (metrics.sensor_errors(log), "inclinometer")


def tracking(runs: list[Shown]) -> Figure:
    """Angles with their reference, errors below."""
    with mpl.rc_context(STYLE):
        figure, axes = make_figure(6.2, 2, sharex=True, height_ratios=(3.0, 2.4))
        for number, run in enumerate(runs):
            _track(axes, run, COLORS[number % len(COLORS)], first=number == 0)
        axes[0].set_title("Bending angle")
        axes[0].set_ylabel("angle (°)")
        axes[1].set_title("Error: angle less reference")
        axes[1].set_ylabel("error (°)")
        axes[1].axhline(0.0, color="#8A8A8A", linewidth=0.7)
        axes[1].set_xlabel("time on the trajectory (s)")
        legend_below(figure, axes[0])
        figure.align_ylabels(axes)
    return figure


def _track(axes: list[Axes], run: Shown, color: str, *, first: bool) -> None:
    errors, against = errors_of(run.log)
    cycles = metrics.tracked(run.log)
    if not len(cycles) or not errors.error_deg.size:
        return
    time_s = (cycles["stamp_ns"] - cycles["stamp_ns"][0]) * 1e-9
    reference = np.interp(errors.time_s, time_s, cycles["reference_deg"])
    _line(axes[0], errors.time_s, reference + errors.error_deg, color, f"{run.label} ({against})")
    _line(axes[1], errors.time_s, errors.error_deg, color, "")
    _line(axes[0], time_s, cycles["reference_deg"], BLACK, "reference" if first else "", dashed=True)


def _line(axis: Axes, x: NDArray[np.float64], y: NDArray[np.float64], color: str, label: str, *, dashed: bool = False) -> None:
    thin = thinned(Curve(label, "", x, np.asarray(y, float)), POINTS)
    style: Any = {"linestyle": (0, (4, 2)), "linewidth": 0.9, "zorder": 1} if dashed else {"linewidth": 1.1}
    axis.plot(thin.time_s, thin.values, color=color, label=label or None, **style)


def legend_below(figure: Figure, axis: Axes) -> None:
    """One legend under all panels, where it covers nothing however long the names are."""
    handles, names = axis.get_legend_handles_labels()
    if handles:
        figure.legend(handles, names, loc="outside lower center", ncols=2, handlelength=1.8)


def distribution(runs: list[Shown]) -> Figure:
    """Share of time with a larger error."""
    with mpl.rc_context(STYLE):
        figure, [axis] = make_figure(3.6, 1)
        for number, run in enumerate(runs):
            values = np.abs(errors_of(run.log)[0].error_deg)
            _exceedance(axis, values, COLORS[number % len(COLORS)], run.label)
        axis.set_xlim(left=0.0)
        axis.set_title("How often the error was larger")
        axis.set_xlabel("|error| (°)")
        axis.set_ylabel("share of the tracked time (%)")
        legend_below(figure, axis)
    return figure


def lateness(runs: list[Shown]) -> Figure:
    """Share of ticks that woke later."""
    with mpl.rc_context(STYLE):
        figure, [axis] = make_figure(3.6, 1)
        for number, run in enumerate(runs):
            late_ms = np.maximum(metrics.lateness_us(run.log) * 1e-3, _LATENESS_LEAST_MS)
            _exceedance(axis, late_ms, COLORS[number % len(COLORS)], run.label)
        axis.set_xscale("log")
        axis.xaxis.set_major_formatter("{x:g}")
        axis.set_title("How often a tick woke later")
        axis.set_xlabel("lateness (ms)")
        axis.set_ylabel("share of ticks (%)")
        legend_below(figure, axis)
    return figure


def _exceedance(axis: Axes, values: NDArray[np.float64], color: str, label: str) -> None:
    """The share of values above each value, in percent, on a logarithmic scale: the rare ones count."""
    values = np.sort(values[np.isfinite(values)])
    axis.set_yscale("log")
    axis.yaxis.set_major_formatter("{x:g}")
    if not values.size:
        return
    share = 100.0 * (values.size - np.arange(values.size)) / values.size
    keep = np.unique(np.r_[np.linspace(0, values.size - 1, 1500).astype(int), np.arange(max(0, values.size - 200), values.size)])
    axis.step(values[keep], share[keep], where="pre", color=color, label=label, linewidth=1.2)
