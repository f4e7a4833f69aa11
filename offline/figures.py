"""The pictures of a run: the panels of the paper's Figs. 6 and 7, pressures, tick lateness, latency hop by hop.

Each function takes a `Log` and its summary and returns a matplotlib figure; nothing here needs a display.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from softloop.offline import metrics
from softloop.offline.log import Log, Records
from softloop.offline.metrics import HOPS, SENSORS
from softloop.offline.summary import paper_figures
from softloop.wire.messages import constant, names_of

# Okabe and Ito's colours: told apart with any colour vision, and in print.
BLACK, ORANGE, SKY, GREEN, BLUE, RED, GREY = "#222222", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#8A8A8A"
DPI = 150
WIDTH_IN = 9.0
STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.2,
}
_LATENESS_LEAST_MS = 0.001  # shown as this: ticks on time to the clock's grain, and early ones
_LATENESS_MARKS: Any = (("p50", "median", "-"), ("p99", "99 %", "--"), ("p99_9", "99.9 %", "-."), ("max", "maximum", ":"))
_APPROACH = constant("CycleRecord", "PHASE_APPROACH")


def make_figure(height_in: float, rows: int, **options: Any) -> tuple[Figure, list[Axes]]:
    """An empty figure of the report's width and its axes, top to bottom."""
    figure = Figure(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, 1, squeeze=False, **options)
    return figure, list(axes[:, 0])


def _styled(draw: Callable[[Log, dict[str, Any]], Figure]) -> Callable[[Log, dict[str, Any]], Figure]:
    def drawn(log: Log, summary: dict[str, Any]) -> Figure:
        with mpl.rc_context(STYLE):
            return draw(log, summary)

    drawn.__doc__, drawn.__name__ = draw.__doc__, draw.__name__
    return drawn


def _shown_cycles(log: Log) -> tuple[Records, int]:
    """The cycle records of approach and track, and the stamp from which their time counts: the first of track."""
    cycles, track = log["cycle"], metrics.tracked(log)
    if not len(track):
        return cycles, int(cycles["stamp_ns"][0]) if len(cycles) else 0
    on_way = (cycles["phase"] == _APPROACH) | (cycles["phase"] == metrics.PHASE_TRACK)
    return cycles[on_way], int(track["stamp_ns"][0])


def _between(records: Records, cycles: Records) -> Records:
    if not len(cycles):
        return records[:0]
    stamps = records["stamp_ns"]
    return records[(stamps >= cycles["stamp_ns"][0]) & (stamps <= cycles["stamp_ns"][-1])]


def _seconds(records: Records, start_ns: int) -> Any:
    return (records["stamp_ns"] - start_ns) * 1e-9


def _mark_approach(axes: list[Axes], cycles: Records, start_ns: int) -> None:
    """Grey ground under what came before the trajectory, and the same limits of time for all panels."""
    if not len(cycles):
        return
    first, last = float(_seconds(cycles[:1], start_ns)[0]), float(_seconds(cycles[-1:], start_ns)[0])
    for axis in axes:
        axis.set_xlim(first, max(last, first + 1e-3))
        if first < 0:
            axis.axvspan(first, 0.0, color="#F1F1F1", zorder=0)
            axis.axvline(0.0, color=GREY, linewidth=0.7)


@_styled
def tracking(log: Log, summary: dict[str, Any]) -> Figure:
    """(a) result, (b) control modes, (c) error with the paper's figures, (d) control inputs: as the paper's Figs. 6 and 7."""
    figure, axes = make_figure(9.6, 4, sharex=True, height_ratios=(3.0, 1.0, 2.4, 2.0))
    cycles, start_ns = _shown_cycles(log)
    _mark_approach(axes, cycles, start_ns)
    _draw_result(axes[0], log, cycles, start_ns)
    _draw_modes(axes[1], cycles, start_ns)
    _draw_errors(axes[2], log, summary)
    _draw_currents(axes[3], cycles, start_ns)
    axes[3].set_xlabel("time on the trajectory (s)")
    figure.align_ylabels(axes)
    return figure


def _legend(axis: Axes) -> None:
    """One row above the panel's right end, where no curve can run under it."""
    handles, labels = axis.get_legend_handles_labels()
    if handles:
        axis.legend(handles, labels, loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=5, borderaxespad=0.0, handlelength=1.6)


def _draw_result(axis: Axes, log: Log, cycles: Records, start_ns: int) -> None:
    sensor, truth = _between(log["inclination"], cycles), _between(log["truth"], cycles)
    if len(sensor):
        axis.plot(_seconds(sensor, start_ns), sensor["angle_deg"], color=SKY, linewidth=2.6, label="inclinometer")
    if len(truth):
        axis.plot(_seconds(truth, start_ns), truth["angle_deg"], color=BLUE, label="true angle")
    if len(cycles):
        axis.plot(
            _seconds(cycles, start_ns),
            cycles["reference_deg"],
            color=BLACK,
            linestyle=(0, (4, 2)),
            linewidth=1.0,
            label="reference",
        )
    axis.set_title("(a)  Trajectory tracking")
    axis.set_ylabel("bending angle (°)")
    _legend(axis)


def _draw_modes(axis: Axes, cycles: Records, start_ns: int) -> None:
    names = names_of("ValveCommand", "MODE_")
    known = np.isin(cycles["mode"], list(names))
    axis.step(_seconds(cycles[known], start_ns), cycles["mode"][known], where="post", color=GREEN, linewidth=0.8)
    axis.set_yticks(list(names), list(names.values()))
    axis.set_ylim(0.6, 3.4)
    axis.set_title("(b)  Control modes")


def _draw_errors(axis: Axes, log: Log, summary: dict[str, Any]) -> None:
    limit = 0.0
    for errors, color, width, label in (
        (metrics.sensor_errors(log), SKY, 0.8, "inclinometer"),
        (metrics.truth_errors(log), BLUE, 1.2, "true angle"),
    ):
        if errors.error_deg.size and np.isfinite(errors.error_deg).all():
            axis.plot(errors.time_s, errors.error_deg, color=color, linewidth=width, label=label)
            limit = max(limit, float(np.abs(errors.error_deg).max()))
    name, paper = paper_figures(summary)
    for controller, color, above in (("ARC (C3)", RED, False), ("SMC (C2)", ORANGE, True)):
        dynamic, steady = paper[controller]
        _dashed(axis, dynamic, color, f"{controller[:3]} {dynamic:.2f}°", above=above)
        limit = max(limit, dynamic)
        if steady is not None and not above:
            _dashed(axis, steady, GREEN, f"ARC steady {steady:.2f}°", above=True)
    axis.set_ylim(-1.15 * limit, 1.15 * limit)
    axis.set_title(f"(c)  Tracking error; dashed: the paper's largest on its {name}")
    axis.set_ylabel("error (°)")
    _legend(axis)


def _dashed(axis: Axes, value: float, color: str, text: str, *, above: bool) -> None:
    """A dashed line on both sides of zero, its text beside the upper one's right end."""
    for side in (value, -value):
        axis.axhline(side, color=color, linewidth=0.9, linestyle=(0, (5, 3)))
    place: Any = {"xycoords": axis.get_yaxis_transform(), "va": "bottom" if above else "top", "fontsize": 7.5, "color": color}
    axis.annotate(text, (1.008, value), **place)


def _draw_currents(axis: Axes, cycles: Records, start_ns: int) -> None:
    for column, color, label in (("charge_current_ma", ORANGE, "charge valve"), ("exhaust_current_ma", BLUE, "exhaust valve")):
        axis.step(_seconds(cycles, start_ns), cycles[column], where="post", color=color, linewidth=0.8, label=label)
    axis.set_title("(d)  Control inputs")
    axis.set_ylabel("current (mA)")
    axis.set_ylim(bottom=0.0)
    _legend(axis)


@_styled
def pressures(log: Log, summary: dict[str, Any]) -> Figure:
    """Chamber pressure, true and measured, with the desired one; the supply below."""
    figure, axes = make_figure(4.6, 2, sharex=True, height_ratios=(3.0, 1.2))
    cycles, start_ns = _shown_cycles(log)
    _mark_approach(axes, cycles, start_ns)
    measured, truth = _between(log["pressure"], cycles), _between(log["truth"], cycles)
    for axis, column in ((axes[0], "chamber_pressure_kpa"), (axes[1], "supply_pressure_kpa")):
        axis.plot(_seconds(measured, start_ns), measured[column], color=SKY, linewidth=1.8, label="sensor")
        if len(truth):
            axis.plot(_seconds(truth, start_ns), truth[column], color=BLUE, label="true")
        axis.set_ylabel("kPa (gauge)")
    desired = cycles["desired_pressure_kpa"]
    axes[0].plot(_seconds(cycles, start_ns), desired, color=RED, linewidth=0.9, linestyle=(0, (4, 2)), label="desired")
    axes[0].set_title("Chamber pressure")
    axes[1].set_title("Supply pressure")
    axes[1].set_xlabel("time on the trajectory (s)")
    _legend(axes[0])
    figure.align_ylabels(axes)
    return figure


@_styled
def lateness(log: Log, summary: dict[str, Any]) -> Figure:
    """How late ticks woke: a histogram, both axes logarithmic, because what matters is the rare late one."""
    figure, [axis] = make_figure(2.9, 1)
    late_ms = np.maximum(metrics.lateness_us(log) * 1e-3, _LATENESS_LEAST_MS)
    if late_ms.size:
        edges = np.geomspace(0.9 * float(late_ms.min()), 1.1 * float(late_ms.max()), 90)
        axis.hist(late_ms, bins=edges.tolist(), color=SKY, log=True)
        axis.set_xscale("log")
        axis.xaxis.set_major_formatter("{x:g}")
        for name, label, dashes in _LATENESS_MARKS:
            value = max(summary[f"tick_late_{name}_us"] * 1e-3, _LATENESS_LEAST_MS)
            axis.axvline(value, color=RED, linewidth=1.0, linestyle=dashes, label=f"{label} {value:.2f} ms")
        axis.legend(loc="upper right", frameon=True, framealpha=1.0, edgecolor="none")
    axis.set_title(f"Tick lateness: woken less scheduled; {summary['ticks']} ticks, {summary['ticks_skipped']} skipped")
    axis.set_xlabel("lateness (ms)")
    axis.set_ylabel("ticks")
    return figure


@_styled
def latency(log: Log, summary: dict[str, Any]) -> Figure:
    """Sensor to coil, hop by hop: columns to the median, lines to the 99th percentile."""
    figure, [axis] = make_figure(3.4, 1)
    labels = [
        "sensor\nto adapter",
        "in\nadapter",
        "wait for\ntick",
        "compute",
        "publish",
        "Zenoh\nto gate",
        "in gate",
        "bus and\ndriver",
    ]
    for index, (sensor, color) in enumerate(zip(SENSORS, (SKY, ORANGE), strict=True)):
        for place, (hop, _, _) in enumerate(HOPS):
            _column(axis, place + 0.36 * (index - 0.5), summary, f"latency_{sensor}_{hop}", color)
        axis.bar([0.0], [0.0], color=color, label=f"{sensor}: {_total_text(summary, sensor)}")
    axis.set_xticks(range(len(HOPS)), labels)
    axis.grid(visible=False, axis="x")
    axis.set_ylabel("ms")
    axis.set_ylim(bottom=0.0)
    axis.margins(y=0.15)
    axis.set_title("Latency from sensor to coil; column and number: median, line: 99th percentile")
    axis.legend(loc="upper right", frameon=True, framealpha=1.0, edgecolor="none")
    return figure


def _column(axis: Axes, place: float, summary: dict[str, Any], prefix: str, color: str) -> None:
    median, high = summary[f"{prefix}_p50_us"], summary[f"{prefix}_p99_us"]
    if median is None or high is None:
        return
    axis.bar([place], [median * 1e-3], width=0.32, color=color)
    axis.vlines([place], median * 1e-3, high * 1e-3, color=BLACK, linewidth=1.0)
    axis.annotate(f"{median * 1e-3:.2f}", (place, high * 1e-3), (0, 2), textcoords="offset points", ha="center", fontsize=7)


def _total_text(summary: dict[str, Any], sensor: str) -> str:
    for hop, word in (("total", "sensor to coil"), ("to_bus", "sensor to bus")):
        median, high = summary[f"latency_{sensor}_{hop}_p50_us"], summary[f"latency_{sensor}_{hop}_p99_us"]
        if median is not None:
            return f"{word} {median * 1e-3:.2f} ms, 99 % within {high * 1e-3:.2f} ms"
    return "no complete chain in the log"


# Name of the PNG file, its caption, and what draws it.
PICTURES: tuple[tuple[str, str, Callable[[Log, dict[str, Any]], Figure]], ...] = (
    (
        "tracking",
        "Tracking result, control modes, tracking error and control inputs, arranged as the paper's Figs. 6 and 7.",
        tracking,
    ),
    ("pressures", "Pressures. The desired pressure is the controller's own, Eq. 35 for the ARC.", pressures),
    ("lateness", "How late the controller's ticks woke.", lateness),
    ("latency", "Where the time goes between a sensor's sampling and the valve's coil.", latency),
)
