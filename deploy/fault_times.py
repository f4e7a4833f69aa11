"""Whether what a bench injects comes while its run lasts.

Not a part of reading a bench: `--duration` has its say, and the log of a run in which nothing came is still to be read.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from softloop.deploy.bench import Bench
from softloop.wire.channels import TICK
from softloop.wire.errors import BadConfig

_TICK_S = 1.0 / TICK.rate_hz


def check_times(bench: Bench, file: Path) -> None:
    """Refuse what surely never comes. Raises BadConfig in one line that begins with `file`."""
    end_s = over_s(bench)
    late = None if end_s is None else next(_late(bench, end_s), None)
    if late is None:
        return
    run = bench.run
    stopped = "" if bench.pace.mode == "lockstep" else f", stopped in {run.stop_timeout_s:g} s"
    raise BadConfig(
        f"{file}: key '{late}': the run is over by then: armed for {run.duration_s:g} s, vented in {run.vent_timeout_s:g} s"
        f"{stopped} at most; let it begin earlier or the run last longer"
    )


def over_s(bench: Bench) -> float | None:
    """How long after arming nothing can be injected any more; None: nobody knows.

    What is injected counts from arming, not from what the gate is, so it also comes while the rig vents and its processes stop.
    A run without `duration_s` ends with its trajectory; one that waits for a router or another host that is away, later.
    """
    run = bench.run
    if not run.duration_s or run.shared_router or bench.hosts:
        return None
    return run.duration_s + run.vent_timeout_s + (_TICK_S if bench.pace.mode == "lockstep" else run.stop_timeout_s)


def _late(bench: Bench, end_s: float) -> Iterator[str]:
    """The keys of what begins when all is over."""
    for place, injection in enumerate(bench.faults.injections):
        if injection.at_s >= end_s:
            yield f"faults.injections.{place}.at_s"
    if bench.plant is None:
        return
    before_s = 0.0 if bench.plant.faults_from == "armed" else _until_armed_s(bench)
    for place, fault in enumerate(bench.plant.faults):
        if fault.on_s >= before_s + end_s:
            yield f"plant.faults.{place}.on_s"


def _until_armed_s(bench: Bench) -> float:
    """The longest that a run takes from its plant's start to arming."""
    run = bench.run
    return run.settle_s + (0.0 if bench.pace.mode == "lockstep" else run.ready_timeout_s + run.arm_timeout_s)
