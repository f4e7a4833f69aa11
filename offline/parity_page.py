"""The page and pictures of `softloop parity`."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from softloop.offline.compare_figures import POINTS, legend_below
from softloop.offline.figures import BLUE, GREY, ORANGE, RED, STYLE, make_figure
from softloop.offline.page import document, picture, table, text
from softloop.offline.parity import RATE_HZ, Compared, Parity
from softloop.offline.parity_bounds import ChannelBounds, ParityBounds
from softloop.offline.plot import Curve, thinned
from softloop.offline.spectra import Estimate, spectra
from softloop.offline.vector import as_bytes, write

PAGE, SIGNALS_PICTURE, SPECTRA_PICTURE = "parity.html", "parity_channels", "parity_spectra"
NONE = "-"
HEADS = ("channel", "unit", "RMS B - A", "mean B - A", "coherence", "delay, ms", "gain", "band, Hz", "verdict")
_CAPTIONS = {
    SIGNALS_PICTURE: "Each judged channel of both runs over the time on the trajectory, and B less A below it.",
    SPECTRA_PICTURE: "Coherence and gain of B over A by frequency; dots are the excited frequencies, which are judged.",
}


def cells(one: Compared, bounds: ChannelBounds) -> tuple[str, ...]:
    """A row of the table, in the order of HEADS."""
    found = one.found
    band = NONE if found.low_hz is None else f"{found.low_hz:.2f}-{found.high_hz:.2f}"
    verdict = "FAIL" if one.reasons else "pass" if bounds.judges else "not judged"
    return (
        one.signal.name,
        one.signal.unit,
        f"{found.residual_rms:.3f}",
        f"{found.offset:+.3f}",
        *_estimated(found),
        band,
        verdict,
    )


def _estimated(found: Estimate) -> tuple[str, str, str]:
    shown = ((found.coherence, "{:.4f}"), (found.delay_ms, "{:+.2f}"), (found.gain, "{:.4f}"))
    first, second, third = (NONE if value is None else form.format(value) for value, form in shown)
    return first, second, third


def write_page(parity: Parity, bounds: ParityBounds, names: tuple[str, str], set_up: str, folder: Path) -> Path:
    """Write the page, and its pictures as SVG and PNG, into `folder`; returns the page. Raises BadFile.

    Args:
        names: of the runs. set_up: markup that says what differs in their set-up.
    """
    judged = [one for one in parity.channels if bounds.of(one.signal.name).judges]
    pictures = []
    for name, figure in ((SIGNALS_PICTURE, signals_figure(parity, judged, names)), (SPECTRA_PICTURE, _spectra(judged, bounds))):
        svg = as_bytes(figure, "svg")
        write(folder / f"{name}.svg", svg)
        write(folder / f"{name}.png", as_bytes(figure, "png"))
        pictures.append(picture(_CAPTIONS[name], svg))
    target = folder / PAGE
    write(target, _page(parity, bounds, names, set_up, pictures).encode())
    return target


def _page(parity: Parity, bounds: ParityBounds, names: tuple[str, str], set_up: str, pictures: list[str]) -> str:
    rows = [[text(cell) for cell in cells(one, bounds.of(one.signal.name))] for one in parity.channels]
    why = [f"<li>{text(one.signal.name)}: {text(reason)}</li>" for one in parity.channels for reason in one.reasons]
    verdict = "B is within the bounds." if parity.passed else "B is not within the bounds:"
    parts = [
        "<h1>Parity of two runs</h1>",
        f'<p class="lead">A: {text(names[0])}; B: {text(names[1])}; same {text(parity.kind)}, '
        f"{parity.time_s[-1] - parity.time_s[0]:.1f} s</p>",
        f'<p class="verdict{"" if parity.passed else " bad"}">{verdict}</p>',
        f"<ul>{''.join(why)}</ul>" if why else "",
        table(list(HEADS), rows),
        "<h2>Pictures</h2>",
        *pictures,
        "<h2>What differs in their set-up</h2>",
        set_up,
    ]
    return document("Parity of two runs", parts)


def signals_figure(parity: Parity, judged: list[Compared], names: tuple[str, str]) -> Figure:
    """Two panels for each channel: both runs, and what is between them."""
    with mpl.rc_context(STYLE):
        figure, axes = make_figure(1.0 + 2.2 * len(judged), 2 * len(judged), sharex=True, height_ratios=(2.0, 1.0) * len(judged))
        for one, above, below in zip(judged, axes[::2], axes[1::2], strict=True):
            for values, color, name in ((one.a, BLUE, names[0]), (one.b, ORANGE, names[1])):
                _line(above, parity, values, color, name if one is judged[0] else None)
            _line(below, parity, one.b - one.a, RED, None)
            above.set_ylabel(f"{one.signal.name.replace('_', ' ')}\n({one.signal.unit})")
            below.set_ylabel("B - A")
        axes[-1].set_xlabel("time on the trajectory (s)")
        legend_below(figure, axes[0])
        figure.align_ylabels(axes)
    return figure


def _line(axis: Axes, parity: Parity, values: np.ndarray, color: str, label: str | None) -> None:
    thin = thinned(Curve("", "", parity.time_s, values), POINTS)
    axis.plot(thin.time_s, thin.values, color=color, linewidth=0.9, label=label)


def _spectra(judged: list[Compared], bounds: ParityBounds) -> Figure:
    """Coherence above, gain below, a colour for each channel."""
    with mpl.rc_context(STYLE):
        figure, axes = make_figure(5.2, 2, sharex=True)
        for number, one in enumerate(judged):
            found = spectra(one.a, one.b, RATE_HZ, bounds.estimate)
            if found is None:
                continue
            color = mpl.colormaps["tab10"](number)
            for axis, values, name in ((axes[0], found.coherence, one.signal.name.replace("_", " ")), (axes[1], found.gain, "")):
                axis.plot(found.hz[1:], values[1:], color=color, linewidth=0.7, alpha=0.45)
                axis.plot(found.hz[found.excited], values[found.excited], ".", color=color, markersize=5, label=name or None)
        axes[0].set_ylabel("coherence")
        axes[1].set_ylabel("gain, B over A")
        axes[1].axhline(1.0, color=GREY, linewidth=0.7)
        axes[1].set_ylim(0.0, 2.0)
        axes[1].set_xscale("log")
        axes[1].set_xlim(0.5 / bounds.estimate.segment_s, 20.0)
        axes[1].xaxis.set_major_formatter("{x:g}")
        axes[1].set_xlabel("frequency (Hz)")
        legend_below(figure, axes[0])
    return figure
