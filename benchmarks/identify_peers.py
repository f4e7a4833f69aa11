"""The model's memory structure beside two libraries that a user would pick for the same job, on the same CSV files.

    python benchmarks/identify_peers.py FILE FILE... --map time=... --map pressure=...,... --map angle=...  [--json]

The first file trains, all others are simulated freely. Needs the extra `benchmark` (sysidentpy and jax-sysid). Each peer gets
several settings; the one that is best on the *unseen* files is shown, a choice in its favour. softloop gets one setting.
sysidentpy is given samples at 5 Hz where the file is faster: its free runs were poor at 25 Hz.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from softloop.offline.identification.csv_map import parse_map, read_csv
from softloop.offline.identification.fitting import fit_output_error
from softloop.offline.identification.output_error import score
from softloop.offline.identification.series import Series, nrmse_fit
from softloop.offline.identification.structure import Structure

NARX_HZ = 5.0
EPOCHS = 1000
Predictor = Callable[[Series], np.ndarray]


@dataclass(frozen=True)
class Row:
    """A method's fits, training file first, and what the fit took."""

    name: str
    fits: list[float]
    seconds: float


def softloop_rows(runs: list[Series]) -> list[Row]:
    inputs, rows = runs[0].pressure_kpa.shape[1], []
    structures = {
        "softloop, linear (Eq. 1)": Structure(m=0, r=0, inputs=inputs),
        "softloop, Eq. 2": Structure(inputs=inputs, at_rest=True),
        "softloop, Eq. 2 with memory": Structure(inputs=inputs, hysteresis=1, creep=1, at_rest=True),
    }
    for name, structure in structures.items():
        begin = time.perf_counter()
        fit = fit_output_error(structure, runs[:1])
        spent = time.perf_counter() - begin
        rows.append(Row(name, [fit.fits[0], *(score(fit, run) for run in runs[1:])], spent))
    return rows


def thinned(run: Series) -> tuple[np.ndarray, np.ndarray, int]:
    """Pressures and angle at about NARX_HZ, and how many samples were made one."""
    step = max(1, round(1.0 / NARX_HZ / run.sample_s))
    return run.pressure_kpa[::step], run.angle_deg[::step, None], step


def narx(train: Series, degree: int, terms: int, *, together: bool, lag: int = 2) -> Predictor:
    """A NARX model; `together` gives it one input, the pressures weighted by their static gains."""
    from sysidentpy.basis_function import Polynomial  # noqa: PLC0415 - a benchmark extra
    from sysidentpy.model_structure_selection import FROLS  # noqa: PLC0415
    from sysidentpy.parameter_estimation import LeastSquares  # noqa: PLC0415

    x, y, _ = thinned(train)
    weights = np.linalg.lstsq(x, y, rcond=None)[0] if together else np.eye(x.shape[1])
    x = x @ weights
    lags: Any = [list(range(1, lag + 1))] * x.shape[1] if x.shape[1] > 1 else lag
    basis = Polynomial(degree=degree)
    model = FROLS(order_selection=False, n_terms=terms, ylag=lag, xlag=lags, estimator=LeastSquares(), basis_function=basis)
    model.fit(X=x, y=y)

    def predict(run: Series) -> np.ndarray:
        pressures, angle, step = thinned(run)
        simulated = model.predict(X=pressures @ weights, y=angle[:lag])[:, 0]
        return np.interp(np.arange(len(run.angle_deg)), np.arange(len(simulated)) * step, simulated)

    return predict


def neural(train: Series, states: int, hidden: int) -> Predictor:
    import jax  # noqa: PLC0415
    from jax_sysid.models import Model  # noqa: PLC0415
    from jax_sysid.utils import standard_scale, unscale  # noqa: PLC0415

    jax.config.update("jax_enable_x64", True)
    u, umean, ugain = standard_scale(train.pressure_kpa)
    y, ymean, ygain = standard_scale(train.angle_deg[:, None])
    nu, random = u.shape[1], np.random.RandomState(1)

    @jax.jit
    def state(x: Any, u: Any, p: Any) -> Any:
        a, b, w1, w2, w3, b1, b2 = p
        return a @ x + b @ u + w3 @ jax.nn.sigmoid(w1 @ x + w2 @ u + b1) + b2

    @jax.jit
    def output(x: Any, u: Any, p: Any) -> Any:
        return x[:1]

    model = Model(states, 1, nu, state_fcn=state, output_fcn=output)
    small = [
        0.1 * random.standard_normal(s) for s in ((states, nu), (hidden, states), (hidden, nu), (states, hidden), hidden, states)
    ]
    model.init(params=[0.9 * np.eye(states), *small], x0=np.zeros(states))
    model.loss(rho_x0=1e-4, rho_th=1e-5)
    model.optimization(adam_epochs=0, lbfgs_epochs=EPOCHS, iprint=-1)
    model.fit(y, u)

    def predict(run: Series) -> np.ndarray:
        pressures = (run.pressure_kpa - umean) * ugain
        begin = np.concatenate([(run.angle_deg[:1] - ymean) * ygain, np.asarray(model.x0)[1:]])
        simulated, _ = model.predict(begin, pressures)
        return unscale(np.asarray(simulated), ymean, ygain)[:, 0]

    return predict


def best_of(name: str, runs: list[Series], makers: dict[str, Callable[[], Predictor]]) -> Row:
    """The setting with the best mean fit on unseen files, its time alone."""
    rows = []
    for setting, make in makers.items():
        begin = time.perf_counter()
        try:
            predict = make()
            spent = time.perf_counter() - begin
            fits = [nrmse_fit(run.angle_deg, predict(run)) for run in runs]
        except Exception as error:  # noqa: BLE001 - a peer's failure is a result
            print(f"{name}, {setting}: failed: {error!r}")
            continue
        rows.append(Row(f"{name}, {setting}", [f if np.isfinite(f) else float("-inf") for f in fits], spent))
    return max(rows, key=lambda r: float(np.mean(r.fits[1:])), default=Row(f"{name}: none worked", [], 0.0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--map", action="append", default=[], metavar="KEY=COLUMN", dest="columns")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    columns = parse_map(asked.columns)
    runs = [read_csv(path, columns) for path in asked.files]
    rows = softloop_rows(runs)
    degrees = {
        f"degree {d}, {n} terms{', one input' * one}": lambda d=d, n=n, one=one: narx(runs[0], d, n, together=one)
        for d, n in ((1, 4), (2, 6), (2, 10), (3, 6), (3, 10), (3, 15))
        for one in (False, True)
    }
    networks = {f"{s} states, {h} neurons": lambda s=s, h=h: neural(runs[0], s, h) for s, h in ((2, 6), (3, 8))}
    rows += [best_of("sysidentpy NARX", runs, degrees), best_of("jax-sysid", runs, networks)]
    if asked.json:
        print(json.dumps([vars(row) for row in rows], indent=2))
        return
    table = Table(title="fit by free simulation, NRMSE in %; the first file trained")
    for heading in ("method", *(run.name for run in runs), "fit, s"):
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(row.name, *(f"{f:.2f}" for f in row.fits), f"{row.seconds:.1f}")
    Console(highlight=False).print(table)


if __name__ == "__main__":
    main()
