"""Figs. 6 and 7 for all laws side by side: one column per law; angle, error, pressure, working mode."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from softloop.offline.closed_loop import Run
from softloop.offline.figures import BLACK, BLUE, DPI, ORANGE, RED
from softloop.wire.messages import names_of

_STYLE: Any = {
    "font.size": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "lines.linewidth": 0.9,
    "legend.frameon": False,
}
_ROWS = ("angle, deg", "error, deg", "chamber, kPa", "working mode")
_MODES = {number: name for number, name in names_of("ValveCommand", "MODE_").items() if number}
_ERROR_SHOWN_DEG = 2.0


def side_by_side(runs: Mapping[str, Run], title: str) -> Figure:
    """One column per law; errors are cut at +-2 deg."""
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(2.6 * len(runs), 6.5), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots(len(_ROWS), len(runs), squeeze=False, sharex=True, sharey="row")
        for column, (law, run) in enumerate(runs.items()):
            _draw(axes[:, column], law, run)
        for row, label in enumerate(_ROWS):
            axes[row, 0].set_ylabel(label)
        for row in (0, 2):
            _legend_above(axes[row, 0])
        figure.suptitle(title)
    return figure


def _legend_above(axes: Any) -> None:
    """A legend in a strip of its own over the curves, whatever these do."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.22 * (high - low))
    axes.legend(loc="upper left", ncols=2, handlelength=1.5, columnspacing=1.0, borderaxespad=0.1)


def _draw(axes: Any, law: str, run: Run) -> None:
    on = run.cycles["trajectory_ns"] >= 0
    cycles, truths = run.cycles[on], run.truths[on]
    time = 1e-9 * cycles["trajectory_ns"]
    error = truths["angle_deg"] - cycles["reference_deg"]
    axes[0].plot(time, truths["angle_deg"], color=BLUE, linewidth=1.6, label="true angle")
    axes[0].plot(time, cycles["reference_deg"], color=BLACK, linestyle=(0, (4, 3)), linewidth=0.8, label="reference")
    axes[1].plot(time, error, color=RED)
    axes[1].set_ylim(-_ERROR_SHOWN_DEG, _ERROR_SHOWN_DEG)
    axes[2].plot(time, cycles["desired_pressure_kpa"], color=ORANGE, label="desired")
    axes[2].plot(time, truths["chamber_pressure_kpa"], color=BLACK, label="true")
    axes[3].step(time, cycles["mode"], color=BLACK, linewidth=0.4, where="post")
    axes[3].set_yticks(list(_MODES), _MODES.values())
    axes[3].set_ylim(min(_MODES) - 0.3, max(_MODES) + 0.3)
    axes[3].set_xlabel("time, s")
    axes[0].set_title(f"{law}: max {np.abs(error).max():.2f} deg")


def save(figure: Figure, path: Path) -> None:
    """Write a PNG."""
    figure.savefig(path)
