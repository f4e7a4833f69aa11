"""The picture of a campaign: how the scores of all rigs are distributed, one panel per trajectory, one curve per law."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from softloop.offline.campaign import PAPER, Group, Result
from softloop.offline.figures import BLUE, GREEN, GREY, ORANGE, RED, SKY, STYLE, make_figure

_COLORS = (BLUE, ORANGE, GREEN, SKY, RED)
PANEL_IN = 2.7


def distribution(results: Sequence[Result]) -> Figure:
    """Share of rigs whose largest error stays under a value: with the payload dashed, the paper's figure as a line."""
    with mpl.rc_context(STYLE):
        trajectories = list(dict.fromkeys(r.case.trajectory for r in results))
        laws = list(dict.fromkeys(r.case.law for r in results))
        figure, axes = make_figure(0.5 + PANEL_IN * len(trajectories), len(trajectories))
        for axis, trajectory in zip(axes, trajectories, strict=True):
            _panel(axis, trajectory, laws, [r for r in results if r.case.trajectory == trajectory])
        axes[-1].set_xlabel("largest error on the trajectory (°)")
        return figure


def _panel(axis: Axes, trajectory: str, laws: list[str], results: list[Result]) -> None:
    groups: dict[Group, list[float]] = {}
    for result in results:
        groups.setdefault(result.case.group, []).append(result.scores.max_error_deg)
    for group, errors in groups.items():
        _curve(axis, group, np.sort(errors), _COLORS[laws.index(group.law) % len(_COLORS)])
    if trajectory in PAPER:
        axis.axvline(PAPER[trajectory][0], color=GREY, linewidth=1.0, linestyle=(0, (5, 3)), label="paper's ARC")
    axis.set_xscale("log")
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))  # every digit would not fit
    axis.xaxis.set_minor_formatter("{x:g}")
    axis.tick_params(axis="x", which="minor", labelsize=7)
    axis.set_ylim(0.0, 1.02)
    axis.set_ylabel("share of rigs")
    axis.set_title(f"{trajectory}: {max(len(errors) for errors in groups.values())} rigs")
    axis.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=6, borderaxespad=0.0, handlelength=1.6)


def _curve(axis: Axes, group: Group, errors: Any, color: str) -> None:
    """The empirical distribution; a run that was lost lies beyond every value, so the curve then ends under 1."""
    shares = np.arange(1, len(errors) + 1) / len(errors)
    finite = np.isfinite(errors)
    at, height = errors[finite], shares[finite]
    if at.size:  # rises from zero
        at, height = np.append(at[0], at), np.append(0.0, height)
    label = f"{group.law}, payload" if group.payload else group.law
    axis.step(at, height, where="post", color=color, linestyle="--" if group.payload else "-", label=label)
