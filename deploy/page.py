"""`softloop page`: the live page of a bench, beside a running one or, with `--launch`, starting experiments itself."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

from softloop.controller.config import ControllerConfig
from softloop.deploy.bench import Bench, find_bench, load_bench
from softloop.deploy.children import PROGRAM
from softloop.deploy.experiments import Experiments
from softloop.deploy.fault_requests import offer_faults
from softloop.deploy.rig_state import event_line
from softloop.deploy.signals import stop_on_signals
from softloop.deploy.watching import overview_of
from softloop.watch.page.app import Site
from softloop.watch.page.feed import Feed
from softloop.watch.page.requests import StopLine
from softloop.watch.page.server import serve
from softloop.wire.errors import EXIT_OK

TRAJECTORIES = ("t1", "t2", "excitation_1hz", "excitation_05hz")
BOUNDS_S = 120.0


def page(bench_file: Path, port: int | None, *, launch: bool) -> int:
    """Serve the page until Ctrl-C. Raises BadFile, BadConfig, Unavailable as `serve` and `load_bench` do."""
    file = find_bench(bench_file)
    bench = load_bench(file)
    config = bench.page if port is None else bench.page.model_copy(update={"port": port})
    feed = Feed(overview_of(bench), event_line, config.history_s)
    site = Site(feed, StopLine(), hello_of(bench))
    offer_faults(site)
    with stop_on_signals() as stop, _experiments(bench, file, site, launch=launch):
        threading.Thread(target=_tell_bounds, args=(file, site), name="bounds", daemon=True).start()
        serve(site, config, bench.zenoh, bench.name, stop, _say_where)
    return EXIT_OK


def _say_where(address: str) -> None:
    print(f"live page: {address}", flush=True)


def hello_of(bench: Bench) -> dict[str, Any]:
    """What a viewer is told first of a bench."""
    hello: dict[str, Any] = {"bench": bench.name, "parameters": [], "actions": []}
    if bench.controller is not None:
        own = bench.controller
        hello |= {"law": own.law, "trajectory": own.trajectory}
        hello["budgets_ms"] = {"pressure": own.pressure_budget_ms, "inclination": own.inclination_budget_ms}
    return hello


@contextlib.contextmanager
def _experiments(bench: Bench, file: Path, site: Site, *, launch: bool) -> Iterator[None]:
    """With `launch`: what the page needs to start and end runs; the last one is ended with the page."""
    if not launch or bench.controller is None:
        yield
        return
    with Experiments(bench, file) as runs:

        def tell() -> None:
            site.feed.more["experiment"] = runs.state()

        runs.on_change = tell
        tell()
        site.actions = {**site.actions, "start": runs.start, "end": runs.end}
        site.hello["actions"] = sorted(site.actions)
        trajectories = dict.fromkeys((*TRAJECTORIES, bench.controller.trajectory))
        laws = get_args(ControllerConfig.model_fields["law"].annotation)
        site.hello["experiments"] = {"law": laws, "trajectory": list(trajectories)}
        yield


def _tell_bounds(file: Path, site: Site) -> None:
    """Ask a process of its own for the parameters' bounds, so that this one needs no compiler, and tell all viewers."""
    command = [*PROGRAM, "bounds", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=BOUNDS_S, check=False, stdin=subprocess.DEVNULL)
    if done.returncode == EXIT_OK:
        site.hello["parameters"] = site.feed.more["parameters"] = json.loads(done.stdout)
    else:
        sys.stderr.write(done.stderr)


def bounds(bench_file: Path) -> int:
    """`softloop bounds`: names, starting values and bounds of the parameters that a bench's controller adapts, as JSON."""
    from softloop.dynamics.parameters import THETA_NAMES, load_parameters, model_record, shipped  # noqa: PLC0415 - brings numba

    os.nice(10)  # a rig may be starting on the same cores
    controller = load_bench(find_bench(bench_file)).controller
    if controller is None:
        print("[]")
        return EXIT_OK
    named = controller.parameters
    model = model_record(load_parameters(shipped(named) if shipped(named).is_file() else Path(named)))
    columns = zip(THETA_NAMES, model.theta, model.theta_min, model.theta_max, strict=True)
    print(json.dumps([{"name": n, "value": float(v), "min": float(low), "max": float(high)} for n, v, low, high in columns]))
    return EXIT_OK
