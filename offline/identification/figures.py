"""Pictures of an identification: measured and simulated angle, as in the paper's Figs. 2c and 2d."""

from __future__ import annotations

import matplotlib as mpl
from matplotlib.figure import Figure

from softloop.offline.figures import BLACK, BLUE, RED, STYLE, _legend, make_figure
from softloop.offline.identification.output_error import Fit, free_run
from softloop.offline.identification.series import Series, nrmse_fit

PANEL_IN = 2.2


def validation(fit: Fit, runs: list[Series]) -> Figure:
    """One panel for each run: angle as measured and as simulated, and ten times their difference."""
    with mpl.rc_context(STYLE):
        figure, axes = make_figure(PANEL_IN * len(runs), len(runs))
        for axis, run in zip(axes, runs, strict=True):
            counted, simulated = run.counted, free_run(fit, run)
            time_s, angle = run.time_s[counted], run.angle_deg[counted]
            axis.plot(time_s, angle, color=BLACK, label="measured")
            axis.plot(time_s, simulated[counted], color=RED, label="simulated", linestyle="--")
            axis.plot(time_s, 10.0 * (angle - simulated[counted]), color=BLUE, linewidth=0.7, label="10 x difference")
            axis.set_title(f"{run.name}: fit {nrmse_fit(angle, simulated[counted]):.2f} %")
            axis.set_ylabel("angle (deg)")
            _legend(axis)
        axes[-1].set_xlabel("time (s)")
        return figure
