"""What the doctor says of the devices: each CAN bus and the inclinometer, listened to at rest, whether real or simulated.

A bench with `[plant]` has its simulated rig started for it, with nobody who commands it: what an adapter will hear is heard.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from softloop.deploy.bench import Bench
from softloop.deploy.children import Child, Children
from softloop.deploy.doctor_can import can_checks
from softloop.deploy.doctor_check import Check
from softloop.deploy.doctor_inclinometer import inclinometer
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


def is_real(bench: Bench) -> bool:
    """Whether any device of the bench is a real one."""
    buses = any(not bus_is_simulated(bench, name) for name in buses_of(bench))
    return buses or (bench.inclinometer is not None and not inclinometer_is_simulated(bench))


def buses_of(bench: Bench) -> list[str]:
    """The buses that a device process uses."""
    return sorted({table.can for table in (bench.valves, bench.pressures) if table is not None})


def devices(bench: Bench, run_dir: Path, wire: Wire, seconds: float, clock: Clock | None = None) -> list[Check]:
    """The checks of each bus that a device process uses, and of the inclinometer, for `seconds` each.

    Args:
        run_dir: a folder in which the bench file of this look stands; the simulated rig lives in it.
    """
    if bench.plant is None:
        return listen_to_all(bench, wire, seconds, clock or WallClock())
    with simulated_rig(bench, run_dir, wire) as trouble:
        if trouble:
            return [Check("simulated rig", "fail", trouble, "see that `softloop check` says good")]
        return listen_to_all(bench, wire, seconds, clock or WallClock())


def listen_to_all(bench: Bench, wire: Wire, seconds: float, clock: Clock) -> list[Check]:
    """As `devices`, of a rig that is there."""
    checks = []
    for name in buses_of(bench):
        heard = can_checks(bench, name, wire, clock, seconds)
        checks += [_marked(check) for check in heard] if bus_is_simulated(bench, name) else heard
    if bench.inclinometer is not None:
        check = inclinometer(bench, clock, seconds)
        checks.append(_marked(check) if inclinometer_is_simulated(bench) else check)
    return checks


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
