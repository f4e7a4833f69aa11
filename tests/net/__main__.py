"""The rig on three computers with a network between them: how it tracks and how late its ticks are, and what it survives.

    python -m tests.net [--full] [--seconds 12] [--delays 0,1,5] [--losses 0,1,5] [--over tls,quic]
                        [--incidents cable,router] [--seed 1] [--json F]

Needs root: it makes namespaces, links and a TUN device (`lab.py`), all of which go with it. Every computer has a network and a
monotonic clock of its own; they speak TLS over TCP, or QUIC. Each cell of delay (ms, one way), loss (%) and either is T2 for
`--seconds` armed, with --full all of its 60 s; then a cable is cut and a router killed. Exit codes: 0, 1 when a bound is not
kept, 3 where this machine cannot, 130.
"""

import argparse
import json
import math
import signal
import sys
from contextlib import ExitStack
from dataclasses import asdict
from itertools import product
from pathlib import Path

from rich.console import Console
from rich.table import Table

from tests.net.cable import Way
from tests.net.figures import Cell, failures, read
from tests.net.hosts import AHEAD_S, LOGGER, bench_text, rig_on
from tests.net.incidents import cut_cable, killed_router
from tests.net.lab import Network, counts, missing

JITTER = 0.2  # of the delay, evenly from none to this, on top of it
INCIDENTS = {"cable": cut_cable, "router": killed_router}
# QUIC is not told that a process at the other end is gone: it is known when the link's lease of 5 s ends. See docs/hosts.md.
UNTRIED = {("router", "quic")}
FULL_S = 0.0  # until the trajectory's end
TABLE = (
    ("delay ms", "{network[delay_ms]:g}"), ("loss %", "{loss:g}"), ("by", "{network[by]}"), ("over", "{network[over]}"),
    ("outcome", "{outcome}"),
    ("T2 s", "{f[track_s]:.0f}"), ("max deg", "{f[truth_error_max_deg]:.2f}"), ("rms deg", "{f[truth_error_rms_deg]:.2f}"),
    ("late p50/p99/max us", "{f[tick_late_p50_us]:.0f}/{f[tick_late_p99_us]:.0f}/{f[tick_late_max_us]:.0f}"),
    ("skipped", "{f[ticks_skipped]}"), ("p age p50/p99 ms", "{f[pressure_age_p50_ms]:.1f}/{f[pressure_age_p99_ms]:.1f}"),
    ("clock off/sure ms", "{clock}"), ("relay p99 ms", "{relay}"),
)  # fmt: skip


def measure(network, way, by, over, options) -> Cell:
    """One cell: the rig started on the network, run, and its log read."""
    file = options.json.with_suffix(".relay.json")
    with ExitStack() as held:
        held.enter_context(network.netem(way) if by == "netem" else network.relayed(way, options.seed, file))
        duration_s = FULL_S if options.full else options.seconds
        with rig_on(network, bench_text(network, way, over=over, duration_s=duration_s)) as rigs:
            codes = rigs.finish()
            cell = Cell(asdict(way) | {"by": by, "over": over}, codes)
            try:
                cell.figures, cell.clocks = read(rigs.hosts[LOGGER].run_dir)
            except Exception as error:  # noqa: BLE001 - a run without a log is a result too
                print(f"no log: {error}\n{rigs.report()}", file=sys.stderr)
            if any(codes.values()):
                print(rigs.hosts["desk"].output[-1500:], file=sys.stderr)
            left = rigs.left_over()
    cell.relay = counts(file) if by == "relay" else {}
    cell.failed = failures(cell) + ([f"left over: {left}"] if left else [])
    return cell


def row(cell: Cell) -> list[str]:
    def shown(form):
        try:
            clock = "{:.2f}/{:.2f}".format(*(max(c[key] for c in cell.clocks.values()) for key in CLOCK_KEYS))
            relay = f"{cell.relay['late_us']['p99'] / 1e3:.2f}" if cell.relay else ""
            return form.format(network=cell.network, f=cell.figures, outcome=cell.outcome, clock=clock, relay=relay,
                               loss=100 * cell.network["loss"])  # fmt: skip
        except (TypeError, KeyError, ValueError):  # a figure that there is none of
            return ""

    return [shown(form) for _, form in TABLE]


CLOCK_KEYS = ("error_max_ms", "uncertainty_p50_ms")


def show(cells, incidents):
    """The table for a person, and a line for each incident and each bound that was not kept."""
    table = Table(title="T2 across three hosts, secured", title_justify="left")
    for head, _ in TABLE:
        table.add_column(head, justify="right", no_wrap=False)
    for cell in cells:
        table.add_row(*row(cell))
    console = Console(width=150)
    console.print(table)
    for one in (one for one in incidents if "back_s" in one):
        seen = (
            f"vented {one['vented_ms']:.0f} ms after the loss"
            if one["vented_ms"] < 1e9
            else "vented while nothing could be logged"
        )
        what = f"{seen}, {one['charge_back_ma']:.1f} mA in the charge coil on the return"
        back = f"all channels back after {one['back_s']:.2f} s; restarted: {len(one['restarted'])}"
        again = f"armed again: {'yes' if one['armed_again'] else 'no'}"
        console.print(f"{one['incident']}: {what}; {back}; {again}", soft_wrap=True, highlight=False)
    for name, failed in failed_of(cells, incidents):
        console.print(f"FAILED {name}: {failed}", soft_wrap=True, highlight=False)


def failed_of(cells, incidents):
    named = [
        (f"{c.network['delay_ms']:g} ms {100 * c.network['loss']:g} % ({c.network['by']}, {c.network['over']})", c.failed)
        for c in cells
    ]
    return [(name, text) for name, failed in [*named, *((i["incident"], i["failed"]) for i in incidents)] for text in failed]


def parsed():
    parser = argparse.ArgumentParser(prog="python -m tests.net", description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true", help="all 60 s of T2 in each cell")
    parser.add_argument("--seconds", type=float, default=12.0, help="armed, in each cell")
    parser.add_argument("--delays", default="0,1,5", help="ms, one way")
    parser.add_argument("--losses", default="0,1,5", help="percent")
    parser.add_argument("--over", default="tls,quic", help="what Zenoh goes over: of tls (TCP) and quic (UDP)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--incidents", default="cable,router", help="of cable and router")
    parser.add_argument("--json", type=Path, default=Path("build/net/across_hosts.json"))
    return parser.parse_args()


def finite(found):
    """What JSON can hold: a number that is none becomes null."""
    if isinstance(found, dict):
        return {str(key): finite(value) for key, value in found.items()}
    if isinstance(found, list | tuple):
        return [finite(value) for value in found]
    return None if isinstance(found, float) and not math.isfinite(found) else found


def words(text):
    return [word for word in text.split(",") if word]


def numbers(text):
    return [float(word) for word in words(text)]


def run(options) -> int:
    """All cells and incidents; what was measured is printed and written also when a later one is interrupted."""
    options.json.parent.mkdir(parents=True, exist_ok=True)
    cells, incidents = [], []
    network = Network(AHEAD_S)
    try:
        shapers = ["relay", "netem"] if network.has_netem() else ["relay"]
        print(
            f"delay and loss by: {', '.join(shapers)}" + ("" if "netem" in shapers else " (this kernel has no netem)"), flush=True
        )
        ways = [Way(d, JITTER * d, loss / 100) for loss in numbers(options.losses) for d in numbers(options.delays)]
        for way, by, over in product(ways, shapers, words(options.over)):
            cells.append(measure(network, way, by, over, options))
            print(
                f"{way} by {by} over {over}: {cells[-1].outcome}, {cells[-1].failed or 'bounds kept'}",
                file=sys.stderr,
                flush=True,
            )
        for name, over in product(words(options.incidents), words(options.over)):
            if (name, over) in UNTRIED:
                continue
            incidents.append(tried(INCIDENTS[name], network, over))
            print(f"{incidents[-1]}", file=sys.stderr, flush=True)
    finally:
        network.close()
        show(cells, incidents)
        found = {"full": options.full, "seconds": None if options.full else options.seconds, "seed": options.seed}
        found |= {"cells": [asdict(c) | {"outcome": c.outcome} for c in cells], "incidents": incidents}
        options.json.write_text(json.dumps(finite(found), indent=1) + "\n")
    return 1 if failed_of(cells, incidents) else 0


def tried(incident, network, over):
    """What came of an incident; where it did not even come to it, that as its failure."""
    try:
        return incident(network, over)
    except AssertionError as error:
        print(f"{incident.__name__}: {error}", file=sys.stderr)
        return {
            "incident": f"{incident.__name__.replace('_', ' ')} ({over})",
            "failed": ["did not come to it: the hosts' words are above"],
        }


def main() -> int:
    """Say so where this machine cannot; else run, and be gone without a trace."""
    options, lacks = parsed(), missing()
    if lacks:
        print(f"test-net: {lacks}", file=sys.stderr)
        return 3
    signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
    try:
        return run(options)
    except KeyboardInterrupt:
        print("test-net: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
