"""The 5 ms loop, measured: the whole rig, then the same hops by bare UDP, then cyclictest, one after the other in one run.

    python benchmarks/loop.py [--seconds 60] [--bench sim] [--json]

Software latency is what lies between a sensor's last byte and the valve frame handed to the bus, less the wait for the tick.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from udp_chain import run_chain

from softloop.offline.log import open_log
from softloop.offline.metrics import HOPS, latencies_us, lateness_us

PERCENT = (50.0, 99.0, 99.9, 100.0)
# How the rig's hops stand beside the chain's; the serial packet and the frame on the bus have no counterpart in software.
SOFTWARE = ("adapter", "compute", "publish", "zenoh", "gate")
UDP_HOPS = {
    "adapter": ("adapter_in", "adapter_out"),
    "compute": ("woken", "controller_out"),
    "zenoh": ("controller_out", "gate_in"),
}
UDP_HOPS |= {"gate": ("gate_in", "gate_out")}
STAMPS = ("sent", "adapter_in", "adapter_out", "woken", "controller_out", "gate_in", "gate_out", "driver_in")


def percentiles(values: NDArray[np.float64]) -> list[float]:
    """p50, p99, p99.9 and maximum of what is finite, us."""
    known = values[np.isfinite(values)]
    return [float(v) for v in np.percentile(known, PERCENT)] if known.size else [float("nan")] * len(PERCENT)


def measure_rig(bench: str, seconds: float) -> dict[str, Any]:
    """Run the bench for `seconds` and read lateness and latencies from its log."""
    with tempfile.TemporaryDirectory(prefix="sl-loop-") as folder:
        run_dir = Path(folder) / "run"
        command = [
            sys.executable,
            "-m",
            "softloop.deploy.cli",
            "run",
            bench,
            "--run-dir",
            str(run_dir),
            "--duration",
            str(seconds),
        ]
        # A run that a stall of the machine ends early is measured as far as it went; the launcher says so itself.
        subprocess.run([*command, "--no-report", "--quiet"], check=False, timeout=seconds + 120)
        log = open_log(next(run_dir.glob("*.mcap")))
    cycles = log["cycle"]
    hops = latencies_us(log, "inclination")
    software = np.sum([hops[name] for name in SOFTWARE], axis=0)
    return {
        "lateness": percentiles(lateness_us(log)),
        "hops": {name: percentiles(hops[name]) for name, *_ in HOPS},
        "software": percentiles(software),
        "total": percentiles(hops["total"]),
        "ticks": len(cycles),
        "skipped": int(cycles["skipped_total"][-1]),
    }


def measure_udp(seconds: float, priority: int) -> dict[str, Any]:
    """The UDP chain's lateness, hops and software latency, us."""
    stamps, late = run_chain(seconds, priority)
    at = {name: stamps[:, k] for k, name in enumerate(STAMPS)}
    hops = {name: (at[b] - at[a]) / 1e3 for name, (a, b) in UDP_HOPS.items()}
    return {
        "lateness": percentiles(late / 1e3),
        "hops": {name: percentiles(values) for name, values in hops.items()},
        "software": percentiles(np.sum(list(hops.values()), axis=0)),
    }


def measure_cyclictest(seconds: float, priority: int) -> list[float] | None:
    """Lateness of cyclictest at the same period and priority, us; None where it is not installed."""
    if shutil.which("cyclictest") is None:
        return None
    with tempfile.TemporaryDirectory(prefix="sl-loop-") as folder:
        out = Path(folder) / "cyclictest.json"
        command = ["cyclictest", "-q", "-t1", "-i5000", f"-p{priority}", f"-D{round(seconds)}", "-h20000", f"--json={out}"]
        subprocess.run([*command, "--mlockall"], check=True, timeout=seconds + 30, stdout=subprocess.DEVNULL)
        histogram = json.loads(out.read_text())["thread"]["0"]["histogram"]
    values = np.repeat([float(us) for us in histogram], [int(n) for n in histogram.values()])
    return percentiles(values)


def show(result: dict[str, Any]) -> None:
    """The table for a person."""
    table = Table(title="5 ms loop, us", title_justify="left")
    for head in ("", "p50", "p99", "p99.9", "max", "udp p50", "ratio p50"):
        table.add_column(head, justify="right" if head else "left")
    rig, udp = result["rig"], result["udp"]

    def row(name: str, values: list[float], other: list[float] | None) -> None:
        ratio = [f"{other[0]:.0f}", f"{values[0] / other[0]:.2f}"] if other else ["", ""]
        table.add_row(name, *(f"{v:.0f}" for v in values), *ratio)

    row("tick lateness", rig["lateness"], udp["lateness"])
    for name in rig["hops"]:
        row(f"  {name}", rig["hops"][name], udp["hops"].get(name))
    row("software latency", rig["software"], udp["software"])
    row("sensor to coil", rig["total"], None)
    row("udp: tick lateness", udp["lateness"], None)
    if result["cyclictest"]:
        row("cyclictest: lateness", result["cyclictest"], None)
    console = Console(width=110)
    console.print(table)
    console.print(f"ticks {rig['ticks']}, skipped {rig['skipped']}")
    if result["cyclictest"]:
        ratio = rig["lateness"][2] / result["cyclictest"][2]
        console.print(f"lateness p99.9: {ratio:.2f} times cyclictest's at the same priority")
    else:
        console.print("cyclictest is not installed (Debian: rt-tests); its row is left out")


def main() -> None:
    """Measure, show, and with --json print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--bench", default="sim_t2")
    parser.add_argument("--priority", type=int, default=50)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    result = {
        "rig": measure_rig(options.bench, options.seconds),
        "udp": measure_udp(options.seconds, options.priority),
        "cyclictest": measure_cyclictest(options.seconds, options.priority),
    }
    if options.json:
        print(json.dumps(result))
    else:
        show(result)


if __name__ == "__main__":
    main()
