"""The pictures of the pressure experiment, as the paper's Figs. 2a and 2b."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib as mpl
from matplotlib.figure import Figure

from softloop.offline.excitation import BAR_KPA, PressureTracking
from softloop.offline.figures import BLACK, BLUE, RED, STYLE, _legend, make_figure

PANEL_IN = 2.6


def figure_2ab(runs: Mapping[str, PressureTracking]) -> Figure:
    """A pair of panels for each run: desired and measured pressure, and their difference with the bar of 2 kPa."""
    with mpl.rc_context(STYLE):
        figure, axes = make_figure(PANEL_IN * len(runs), 2 * len(runs), height_ratios=(2.0, 1.0) * len(runs))
        for (name, run), above, below in zip(runs.items(), axes[::2], axes[1::2], strict=True):
            above.plot(run.time_s, run.measured_kpa, color=BLUE, label="measured")
            above.plot(run.time_s, run.desired_kpa, color=BLACK, linestyle="--", linewidth=0.8, label="desired")
            above.set_title(f"{name}: largest error {run.max_kpa:.2f} kPa")
            above.set_ylabel("pressure (kPa)")
            _legend(above)
            below.plot(run.time_s, run.error_kpa, color=RED, linewidth=0.6)
            for side in (-BAR_KPA, BAR_KPA):
                below.axhline(side, color=BLACK, linewidth=0.6, linestyle=":")
            below.set_ylabel("error (kPa)")
        axes[-1].set_xlabel("time on the trajectory (s)")
        return figure
