"""A parameter file from flow tests on a tank: the valves as measured, all else as the tests' own runs had it.

k_v1 and k_v6 get bounds of three standard errors. The flow tests give (r1 / r0)^2 of the charge valve, from which k_v4 and k_v5
follow. The exhaust valve's downstream is the room, so that its k_v4 and k_v5 move nothing and no test shows them: the ratio that
the file had stays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.linalg import block_diag

from softloop.deploy.evidence import base_of, rig_of
from softloop.deploy.identify_files import digest_of
from softloop.dynamics.parameters import Parameters
from softloop.offline.identification.bounds import BOUND_ERRORS
from softloop.offline.identification.intervals import Uncertainty
from softloop.offline.identification.series import nrmse_fit
from softloop.offline.identification.tank_tests import VALVES, Volume, shared_error, span_s
from softloop.offline.identification.valve_flow import NAMES, FlowTests, ValveFit, modelled
from softloop.offline.log import Log
from softloop.wire.benchfile import validated
from softloop.wire.errors import EXIT_NEGATIVE, BadConfig, BadFile, SoftloopError

Floats = NDArray[np.float64]

RATIO = NAMES.index("ratio")
NEEDED = NAMES[:RATIO]
BOUNDED = ("k_v1_m2_ma", "k_v6_m2")
RUN_PREFIX = "supply_"
KEPT = "k_v4 / k_v2 = k_v5 / k_v3, and area_max of both valves"
METHOD = "flow tests on a tank, least squares, white"
HEAD = """\
# [charge] and [exhaust] come from flow tests on a tank; min and max of k_v1 and k_v6 are three standard errors. They hold the
# error of the tank's volume, and not the gain and zero errors of the pressure sensors.
# Kept as they were, because no test shows them: {kept}.
"""


class NotShown(SoftloopError):
    """The tests ran, and do not show what a parameter file needs."""

    exit_code = EXIT_NEGATIVE


@dataclass(frozen=True)
class TankRuns:
    """What was measured on a tank.

    Attributes:
        logs, tests: of each run; its tests by valve.
        fits: of all runs together, by valve.
    """

    logs: Sequence[Log]
    tests: Sequence[Mapping[str, FlowTests]]
    fits: Mapping[str, ValveFit]
    volume: Volume
    discharge: float


def check_identities(evidence_rig: str, rig: str, parameters: str) -> None:
    """Values of another rig's bending must not get this rig's name beside its valves. Raises BadConfig."""
    if evidence_rig != rig:
        raise BadConfig(f"--output: parameters '{parameters}' were identified on rig '{evidence_rig}' and this is '{rig}'; name "
                        "parameters of this rig in [controller]")  # fmt: skip


def write_valves(file: Path, runs: TankRuns) -> None:
    """Write the parameter file of tank runs.

    Raises:
        NotShown: the tests do not show a number that the file needs.
        BadConfig: the values make no usable parameters.
        BadFile: the file cannot be written.
    """
    content = base_of(runs.logs[0])
    sure = {valve: _sure(valve, runs.fits[valve]) for valve in VALVES}
    kept = ("the exhaust valve's " if "ratio" in sure["charge"].names else "both valves' ") + KEPT
    content |= {valve: valve_table(content[valve], sure[valve]) for valve in VALVES}
    content |= {"name": file.stem, "evidence": _evidence(content.get("evidence"), runs, sure)}
    try:
        validated(Parameters, content)
    except ValidationError as error:
        raise BadConfig(f"{file}: the values make no usable parameters: {error.errors()[0]['msg']}") from None
    try:
        file.write_text(HEAD.format(kept=kept) + "\n" + tomlkit.dumps(content), encoding="utf-8")
    except OSError as error:
        raise BadFile(f"{file}: cannot be written: {error.strerror or error}") from None


def _sure(valve: str, fit: ValveFit) -> Uncertainty:
    hidden = [n for n in NEEDED if n not in fit.shown]
    if fit.uncertainty is None or hidden:
        raise NotShown(f"no parameter file is written: the tests of the {valve} valve do not show {', '.join(hidden)}; "
                       "take more supply pressures, further apart, or more currents")  # fmt: skip
    return fit.uncertainty


def valve_table(old: Mapping[str, Any], sure: Uncertainty) -> dict[str, Any]:
    """A valve's table with measured numbers; k_v4 and k_v5 from the ratio that was measured, else from the old one."""
    value = dict(zip(sure.names, sure.values.tolist(), strict=True))
    half = dict(zip(sure.names, (BOUND_ERRORS * sure.errors).tolist(), strict=True))
    ratio = value.get("ratio", old_ratio(old))
    table: dict[str, Any] = {n: value[n] for n in ("k_v2_pa", "k_v3_m2_pa")}
    table |= {"k_v4_pa": value["k_v2_pa"] * ratio, "k_v5_m2_pa": value["k_v3_m2_pa"] * ratio}
    table |= {n: {"value": value[n], "min": value[n] - half[n], "max": value[n] + half[n]} for n in BOUNDED}
    return {name: table.get(name, kept) for name, kept in old.items()}


def old_ratio(old: Mapping[str, Any]) -> float:
    """(r1 / r0)^2 of a valve's table; where it has no flow force, none on the other side either."""
    for over, under in (("k_v4_pa", "k_v2_pa"), ("k_v5_m2_pa", "k_v3_m2_pa")):
        if old[under] > 0.0:
            return float(old[over] / old[under])
    return 0.0


def _evidence(old: Mapping[str, Any] | None, runs: TankRuns, sure: Mapping[str, Uncertainty]) -> dict[str, Any]:
    """The runs, and the covariance of the valves beside what the file had of its bending."""
    names = [f"{valve}.{n}" for valve in VALVES for n in sure[valve].names]
    ours: dict[str, Any] = {
        "rig": rig_of(runs.logs[0]),
        "method": METHOD,
        "softloop": metadata.version("softloop"),
        "parameters": names,
        "covariance": _covariance(sure, runs.volume).tolist(),
        "runs": [_run(runs, i) for i in range(len(runs.logs))],
    }
    return ours if old is None else _beside(old, ours)


def _beside(old: Mapping[str, Any], ours: dict[str, Any]) -> dict[str, Any]:
    """Evidence of the bending stays; that of valves measured before goes, as their values do."""
    kept = [i for i, n in enumerate(old["parameters"]) if not n.startswith(VALVES)]
    if not kept:
        return ours
    before = np.array(old["covariance"], np.float64)[np.ix_(kept, kept)]
    methods = [m for m in old["method"].split("; ") if m != METHOD]
    return ours | {
        "method": "; ".join([*methods, METHOD]),
        "parameters": [*(old["parameters"][i] for i in kept), *ours["parameters"]],
        "covariance": block_diag(before, np.array(ours["covariance"])).tolist(),
        "runs": [*(r for r in old["runs"] if not r["name"].startswith(RUN_PREFIX)), *ours["runs"]],
    }


def _covariance(sure: Mapping[str, Uncertainty], volume: Volume) -> Floats:
    """Of both valves' numbers together: the error of the one tank moves both alike."""
    blocks = block_diag(*(sure[valve].covariance for valve in VALVES))
    share = [shared_error(sure[valve], volume) for valve in VALVES]
    first = len(share[0])
    blocks[:first, first:] = np.outer(share[0], share[1])
    blocks[first:, :first] = blocks[:first, first:].T
    return np.asarray(blocks, np.float64)


def _run(runs: TankRuns, place: int) -> dict[str, Any]:
    log, tests = runs.logs[place], runs.tests[place]
    start_s, end_s = span_s(log)
    measured = np.concatenate([tests[valve].flow_kg_s for valve in VALVES])
    fitted = [modelled(runs.fits[v].values, tests[v], runs.discharge, runs.volume.temperature_k) for v in VALVES]
    return {
        "name": log.path.parent.name,
        "sha256": digest_of(log.path),
        "start_s": start_s,
        "end_s": end_s,
        "fit_percent": nrmse_fit(measured, np.concatenate(fitted)),
        "trained": True,
    }
