"""A parameter file that says where its values come from: bounds, covariance, the logs by their hashes, fits, version, rig."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from pydantic import ValidationError

from softloop.deploy.identify_files import digest_of
from softloop.dynamics.parameters import Parameters, shipped
from softloop.offline.identification.bounds import bounds_of
from softloop.offline.identification.intervals import Uncertainty
from softloop.offline.identification.output_error import Fit, score
from softloop.offline.identification.series import Series
from softloop.offline.identification.structure import PAPER, Structure, bare_of
from softloop.offline.log import Log
from softloop.offline.run_log import open_run
from softloop.offline.summary import judged
from softloop.wire.benchfile import validated
from softloop.wire.errors import BadConfig, BadFile, printable


def write_evidence(file: Path, runs: Sequence[Path], fit: Fit, sure: Uncertainty, series: Sequence[Series]) -> None:
    """Write the parameter file of a fit to logs; what was not identified is as the first log's own parameters have it.

    Args:
        file: where to.
        runs: the logs; the first one's halves are the first two of `series`.
        fit, sure: of the paper's structure, with any options: the controller takes the bending values alone.
        series: what was trained on, first, and tried on.

    Raises:
        BadConfig: the structure is another, or the values make no usable parameter file.
        BadFile: the file cannot be written, or the values come from no log.
    """
    check_usable(runs, fit.structure)
    log = open_run(runs[0])
    content = base_of(log)
    content |= {"name": file.stem, "bending": _bending(sure, series[0])}
    content["evidence"] = _evidence([runs[0], *runs], log, fit, sure, series)
    try:
        validated(Parameters, content)
    except ValidationError as error:
        raise BadConfig(f"{file}: the values make no usable parameters: {error.errors()[0]['msg']}") from None
    try:
        file.write_text(tomlkit.dumps(content), encoding="utf-8")
    except OSError as error:
        raise BadFile(f"{file}: cannot be written: {error.strerror or error}") from None


def check_usable(runs: Sequence[Path], structure: Structure) -> None:
    """Whether a fit of that structure to those logs can make a parameter file. Raises BadConfig."""
    if not runs or bare_of(structure) != PAPER:
        raise BadConfig("--output needs logs, orders 2,0,3 and one pressure: that is the model which the controller has")


def rig_of(log: Log) -> str:
    """The identity of the rig that a log is of."""
    try:
        run = tomllib.loads(log.text("bench.toml")).get("run", {})
    except tomllib.TOMLDecodeError:
        run = {}
    return str(run.get("rig") or log.bench)


def base_of(log: Log) -> dict[str, Any]:
    """The parameter file that a run had, as it stands. Raises BadFile."""
    try:
        return tomllib.loads(log.text("parameters.toml") or shipped().read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise BadFile(f"{log.path}: its parameter file cannot be read: {error}") from None


def _bending(sure: Uncertainty, train: Series) -> dict[str, dict[str, float]]:
    kept = [sure.names.index(name) for name in PAPER.names]
    half = bounds_of(sure.covariance[np.ix_(kept, kept)], train)
    rows = zip(PAPER.names, sure.values[kept].tolist(), half.tolist(), strict=True)
    return {n: {"value": v, "min": v - h, "max": v + h} for n, v, h in rows}


def _evidence(runs: Sequence[Path], log: Log, fit: Fit, sure: Uncertainty, series: Sequence[Series]) -> dict[str, Any]:
    kept = [sure.names.index(name) for name in PAPER.names]
    # The second of `series` is the half of the first log that did not train.
    trained = [i == 0 or (i > 1 and digest_of(path) == digest_of(runs[0])) for i, path in enumerate(runs)]
    fits = [fit.fits[0], *(score(fit, s) for s in series[1:])]
    rows = zip(runs, series, fits, trained, strict=True)
    return {
        "rig": rig_of(log),
        "method": f"{fit.structure}, {sure.method}",
        "softloop": metadata.version("softloop"),
        "parameters": list(PAPER.names),
        "covariance": sure.covariance[np.ix_(kept, kept)].tolist(),
        "runs": [_run(path, s, percent, trained=t) for path, s, percent, t in rows],
    }


def _run(path: Path, series: Series, fit_percent: float, *, trained: bool) -> dict[str, Any]:
    counted = series.time_s[series.counted]
    damage, against = judged(open_run(path))
    return {
        "name": series.name,
        "sha256": digest_of(path),
        "start_s": float(counted[0]),
        "end_s": float(counted[-1]),
        "fit_percent": fit_percent,
        "trained": trained,
        "log_problems": [printable(text) for text in damage],
        "evidence_problems": [printable(text) for text in against],
    }
