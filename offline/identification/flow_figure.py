"""Flow tests and the fitted valve model, as in the paper's Fig. 4."""

from __future__ import annotations

from collections.abc import Mapping

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from softloop.offline.figures import BLACK, STYLE, make_figure
from softloop.offline.identification.valve_flow import FlowTests, ValveFit, modelled

MG = 1e6  # mg in a kg
PANEL_IN = 3.4
TITLES = {
    "charge": "(a)  Charge valve: constant upstream pressure, one mark for each supply",
    "exhaust": "(b)  Exhaust valve: constant downstream pressure",
}
MARKS = "osD^v<>"


def figure_4(tests: Mapping[str, FlowTests], fits: Mapping[str, ValveFit], discharge: float, temperature_k: float) -> Figure:
    """One panel for each valve: measured flows (marks) and the model's (lines) over the pressure that varies."""
    with mpl.rc_context(STYLE):
        figure, axes = make_figure(PANEL_IN * len(tests), len(tests))
        for axis, (valve, measured) in zip(axes, tests.items(), strict=True):
            model = modelled(fits[valve].values, measured, discharge, temperature_k)
            over = measured.downstream_kpa if valve == "charge" else measured.upstream_kpa
            _draw(axis, measured, model, over, by_supply=valve == "charge")
            axis.set_title(f"{TITLES[valve]}; fit {fits[valve].fit:.2f} %")
            axis.set_xlabel("downstream pressure (kPa)" if valve == "charge" else "upstream pressure (kPa)")
            axis.set_ylabel("mass flow (mg/s)")
        return figure


def _draw(axis: Axes, tests: FlowTests, model: np.ndarray, over: np.ndarray, *, by_supply: bool) -> None:
    currents = np.round(tests.current_ma / 5.0) * 5.0
    supplies = np.round(tests.upstream_kpa / 10.0) * 10.0 if by_supply else np.zeros(len(currents))
    colours = mpl.colormaps["viridis"]
    for current in np.unique(currents):
        share = (current - currents.min()) / max(float(np.ptp(currents)), 1.0)
        label: str | None = f"{current:.0f} mA"
        for place, supply in enumerate(np.unique(supplies)):
            these = np.flatnonzero((currents == current) & (supplies == supply))
            these = these[np.argsort(over[these])]
            style = {"color": colours(0.9 * share), "label": label}
            axis.plot(over[these], MG * tests.flow_kg_s[these], MARKS[place % len(MARKS)], markersize=2.5, **style)
            axis.plot(over[these], MG * model[these], color=BLACK, linewidth=0.6)
            label = None
    axis.legend(ncols=2, loc="upper left", bbox_to_anchor=(1.0, 1.0))
