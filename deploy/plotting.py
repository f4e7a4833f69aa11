"""`softloop plot`: fields of a log as a picture."""

from __future__ import annotations

from pathlib import Path

from softloop.offline.plot import curve, plot
from softloop.offline.run_log import open_run
from softloop.offline.vector import save
from softloop.wire.errors import EXIT_OK


def plot_run(run: Path, names: list[str], target: Path | None, first_s: float, last_s: float) -> int:
    """Draw curves of a run into `target` (default: `plot.svg` beside the log) and print its path. Raises BadFile, BadConfig."""
    log = open_run(run)
    curves = [curve(log, name, first_s, last_s) for name in names]
    figure = plot(curves, f"{log.bench or log.path.stem}")
    print(save(figure, target or log.path.with_name("plot.svg")))
    return EXIT_OK
