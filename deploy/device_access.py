"""A bench that does not run, and its devices: for commands that speak with a device beside a run."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import NamedTuple

from softloop.deploy.bench import Bench, find_bench, load_bench
from softloop.deploy.doctor import alone
from softloop.deploy.doctor_devices import simulated_rig
from softloop.deploy.router import launcher_wire
from softloop.deploy.run_dir import bench_lock, keep_bench
from softloop.wire.clock import Clock, WallClock
from softloop.wire.errors import Unavailable
from softloop.wire.session import Wire


class AtRest(NamedTuple):
    """A bench that nobody runs meanwhile."""

    bench: Bench
    wire: Wire
    clock: Clock


@contextmanager
def bench_at_rest(bench_file: Path) -> Iterator[AtRest]:
    """The bench, held so that it cannot be run; a simulated rig of it lives as long as the block.

    Raises:
        BadFile, BadConfig: the bench file is wrong.
        Unavailable: the bench is running, or its simulated rig does not start.
    """
    file = find_bench(bench_file)
    name = load_bench(file).name
    with bench_lock(name), tempfile.TemporaryDirectory(prefix="softloop-") as folder:
        run_dir = Path(folder)
        bench = alone(load_bench(file, run_dir))
        keep_bench(run_dir, bench)
        with launcher_wire(bench) as wire, simulated_rig(bench, run_dir, wire) if bench.plant else nullcontext("") as trouble:
            if trouble:
                raise Unavailable(f"the simulated rig of bench '{name}': {trouble}")
            yield AtRest(bench, wire, WallClock())
