"""What the doctor says of the devices: each CAN bus and the inclinometer, listened to at rest, whether real or simulated.

A bench with `[plant]` has its simulated rig started for it, with nobody who commands it: what an adapter will hear is heard.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from softloop.deploy.bench import PROCESS_NAMES, Bench
from softloop.deploy.children import Child, Children
from softloop.deploy.doctor_can import can_checks
from softloop.deploy.doctor_check import Check
from softloop.deploy.doctor_inclinometer import NAME, inclinometer
from softloop.deploy.router import remove_sockets
from softloop.deploy.run_dir import BENCH_FILE
from softloop.wire.clock import Clock, WallClock
from softloop.wire.session import Wire

PLANT = "plant"
POLL_S = 0.05
SIMULATED = "simulated by [plant]: "


def same_wire(plant_end: str, adapter_end: str) -> bool:
    """Whether the plant's address and an adapter's are the two ends of one simulated wire."""
    return plant_end.removeprefix("pty://").replace("listen://", "socket://") == adapter_end


def bus_is_simulated(bench: Bench, name: str) -> bool:
    """Whether the plant is what answers on `[can.NAME]`."""
    if bench.plant is None:
        return False
    ends = (bench.plant.can_valves, bench.plant.can_analog)
    return name in ends or any(same_wire(str(bench.can[end].channel), str(bench.can[name].channel)) for end in ends)


def inclinometer_is_simulated(bench: Bench) -> bool:
    return bench.plant is not None and bench.inclinometer is not None and same_wire(bench.plant.serial, bench.inclinometer.port)


def is_real(bench: Bench, own: Collection[str] = PROCESS_NAMES) -> bool:
    """Whether any device of the processes `own` is a real one."""
    buses = any(not bus_is_simulated(bench, name) for name in buses_of(bench, own))
    return buses or (has(bench, own, NAME) and not inclinometer_is_simulated(bench))


def has(bench: Bench, own: Collection[str], process: str) -> bool:
    """Whether a process is in the bench, and among `own`: those of the host that is looked at."""
    return process in own and getattr(bench, process) is not None


def buses_of(bench: Bench, own: Collection[str] = PROCESS_NAMES) -> list[str]:
    """The buses that a device process of `own` uses."""
    return sorted({getattr(bench, process).can for process in ("valves", "pressures") if has(bench, own, process)})


def devices(
    bench: Bench, run_dir: Path, wire: Wire, seconds: float, own: Collection[str] = PROCESS_NAMES, clock: Clock | None = None
) -> list[Check]:
    """The checks of each bus that a device process uses, and of the inclinometer, for `seconds` each.

    Args:
        run_dir: a folder in which the bench file of this look stands; the simulated rig lives in it.
        own: the processes of the host that is looked at.
    """
    clock = clock or WallClock()
    if not has(bench, own, PLANT):
        return listen_to_all(bench, wire, seconds, own, clock)
    with simulated_rig(bench, run_dir, wire) as trouble:
        if trouble:
            return [Check("simulated rig", "fail", trouble, "see that `softloop check` says good")]
        return listen_to_all(bench, wire, seconds, own, clock)


def listen_to_all(bench: Bench, wire: Wire, seconds: float, own: Collection[str], clock: Clock) -> list[Check]:
    """As `devices`, of a rig that is there."""
    checks, here = [], has(bench, own, PLANT)
    for name in buses_of(bench, own):
        simulated = bus_is_simulated(bench, name)
        heard = can_checks(bench, name, wire, clock, seconds) if here or not simulated else [_elsewhere(f"CAN {name}")]
        checks += [_marked(check) for check in heard] if simulated else heard
    if has(bench, own, NAME):
        simulated = inclinometer_is_simulated(bench)
        check = inclinometer(bench, clock, seconds) if here or not simulated else _elsewhere(NAME)
        checks.append(_marked(check) if simulated else check)
    return checks


def _elsewhere(name: str) -> Check:
    return Check(name, "pass", "on another host, and not looked at from here")


def _marked(check: Check) -> Check:
    return replace(check, found=f"{SIMULATED}{check.found}", measured={**check.measured, "simulated": True})


@contextmanager
def simulated_rig(bench: Bench, run_dir: Path, wire: Wire) -> Iterator[str]:
    """Let the bench's simulated rig run while the block lasts; gives how it failed to start, or an empty text."""
    children = Children()
    try:
        arguments = ["node", PLANT, str(run_dir / BENCH_FILE), "--run-dir", str(run_dir)]
        child = children.start(PLANT, arguments, run_dir / f"{PLANT}.log")
        yield _wait_alive(bench, child, wire)
        children.stop([[PLANT]], bench.run.stop_timeout_s)
    finally:
        children.close()
        for child in children.all.values():
            remove_sockets(bench, child.pid)


def _wait_alive(bench: Bench, child: Child, wire: Wire) -> str:
    deadline = time.monotonic() + bench.run.ready_timeout_s
    while time.monotonic() < deadline:
        if PLANT in wire.processes_alive(timeout_s=POLL_S):
            return ""
        if child.exit_code() is not None:
            return child.epitaph()
        time.sleep(POLL_S)
    return f"not alive after {bench.run.ready_timeout_s:g} s: {child.last_line()}"
