"""Several laws on one trajectory, from their logs, in the panels of the paper's Figs. 6 and 7."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from softloop.offline import metrics
from softloop.offline.compare_figures import COLORS, errors_of
from softloop.offline.figures import BLACK, STYLE, _draw_currents, _draw_modes, _legend, make_figure
from softloop.offline.log import Log


def figure_67(logs: Mapping[str, Log], law: str) -> Figure:
    """(a) results and (c) errors of every law; (b) control modes and (d) inputs of `law`, which is one of them."""
    with mpl.rc_context(STYLE):
        figure, axes = make_figure(9.0, 4, sharex=True, height_ratios=(3.0, 1.0, 2.4, 2.0))
        for number, (name, log) in enumerate(logs.items()):
            _draw_law(axes, name, log, COLORS[number % len(COLORS)], first=number == 0)
        against = dict.fromkeys(errors_of(log)[1] for log in logs.values())
        cycles = metrics.tracked(logs[law])
        start_ns = int(cycles["stamp_ns"][0]) if len(cycles) else 0
        _draw_modes(axes[1], cycles, start_ns)
        _draw_currents(axes[3], cycles, start_ns)
        axes[0].set_title(f"(a)  Trajectory tracking, {' and '.join(against)}")
        axes[1].set_title(f"(b)  Control modes of {law}")
        axes[2].set_title("(c)  Tracking error")
        axes[3].set_title(f"(d)  Control inputs of {law}")
        axes[0].set_ylabel("bending angle (°)")
        axes[2].set_ylabel("error (°)")
        axes[3].set_xlabel("time on the trajectory (s)")
        for axis in (axes[0], axes[2]):
            _legend(axis)
        figure.align_ylabels(axes)
        return figure


def _draw_law(axes: list[Axes], name: str, log: Log, color: Any, *, first: bool) -> None:
    errors, _ = errors_of(log)
    cycles = metrics.tracked(log)
    if not len(cycles) or not errors.error_deg.size:
        return
    time_s = (cycles["stamp_ns"] - cycles["stamp_ns"][0]) * 1e-9
    reference = np.interp(errors.time_s, time_s, cycles["reference_deg"])
    if first:
        axes[0].plot(time_s, cycles["reference_deg"], color=BLACK, linewidth=0.9, linestyle=(0, (4, 2)), label="reference")
    axes[0].plot(errors.time_s, reference + errors.error_deg, color=color, linewidth=1.0, label=name)
    axes[2].plot(errors.time_s, errors.error_deg, color=color, linewidth=0.8, label=name)
