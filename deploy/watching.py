"""`softloop top` and `softloop echo`: a running bench, looked at from outside."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.live import Live

from softloop.deploy.bench import Bench, find_bench, load_bench
from softloop.deploy.node import PROCESSES
from softloop.deploy.signals import stop_on_signals
from softloop.devices.protocols.wire_time import can_frame_ns
from softloop.plant.config import emulated_buses
from softloop.watch.echo import choose, writer
from softloop.watch.guest import guest_wire
from softloop.watch.overview import Overview
from softloop.watch.top import CpuMeter, screen
from softloop.wire.backlog import Backlog
from softloop.wire.errors import EXIT_LOST, EXIT_OK
from softloop.wire.messages import BadPayload, constant
from softloop.wire.session import Inbox
from softloop.wire.shell import Stop

CAPACITY = 20_000
LOOK_S = 0.25
POLL_S = 0.02
SETTLE_S = 0.5
WIDTH = 130


def overview_of(bench: Bench) -> Overview:
    """An empty overview of a bench, with the names of its processes and the bit rates of its buses."""
    processes = {constant("Event", p.source): p.name for p in PROCESSES}
    # A bus on Zenoh goes by its channel there, any other by its name in the bench file.
    names = {name: str(bus.channel) if bus.interface == "zenoh" else name for name, bus in bench.can.items()}
    bitrates = {names[name]: bus.bitrate for name, bus in bench.can.items()}
    held = emulated_buses(bench.plant, bench.can) if bench.plant is not None else ()
    return Overview(bench.name, bitrates, processes, can_frame_ns, emulated=[names[name] for name in held])


def top(bench_file: Path, seconds: float | None, *, once: bool) -> int:
    """Show a running bench until Ctrl-C, for `seconds`, or one look. Raises Unavailable when it is not running."""
    bench = load_bench(find_bench(bench_file))
    with stop_on_signals() as stop, guest_wire(bench.zenoh, bench.name, f"top-{os.getpid()}") as wire:
        inbox = wire.everything(CAPACITY)
        overview, cpu = overview_of(bench), CpuMeter()
        if once or not sys.stdout.isatty():
            _one_look(inbox, overview, cpu, stop, seconds or 2.0)
        else:
            _keep_looking(inbox, overview, cpu, stop, seconds)
    return EXIT_OK


def _one_look(inbox: Backlog, overview: Overview, cpu: CpuMeter, stop: Stop, seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end and not stop.wait(LOOK_S):
        overview.take(inbox.take_all()[0])
        for status, _ in overview.statuses.values():
            cpu.percent(status.pid)
    console = Console(width=WIDTH) if not sys.stdout.isatty() else Console()
    console.print(screen(overview, cpu, time.monotonic()))


def _keep_looking(inbox: Backlog, overview: Overview, cpu: CpuMeter, stop: Stop, seconds: float | None) -> None:
    end = time.monotonic() + (seconds or 1e9)
    with Live(console=Console(), auto_refresh=False, screen=True) as live:
        while time.monotonic() < end and not stop.wait(LOOK_S):
            overview.take(inbox.take_all()[0])
            live.update(screen(overview, cpu, time.monotonic()), refresh=True)


def echo(text: str, bench_file: Path, count: int | None, rate_hz: float | None, timeout_s: float, *, json_lines: bool) -> int:
    """Print the messages of a channel until `count` of them, Ctrl-C, or `timeout_s` without one.

    Returns:
        EXIT_LOST when nothing came for `timeout_s`, else EXIT_OK.

    Raises:
        BadConfig: no such channel or field.
        Unavailable: the bench is not running.
    """
    bench = load_bench(find_bench(bench_file))
    choice = choose(bench.name, text)
    line = writer(choice, json_lines=json_lines)
    with stop_on_signals() as stop, guest_wire(bench.zenoh, bench.name, f"echo-{os.getpid()}") as wire:
        inbox = Inbox(wire.session, choice.key_expr, capacity=CAPACITY)
        printed, heard_s = 0, time.monotonic()
        while not stop and (count is None or printed < count):
            item = inbox.take(POLL_S)
            if item is not None:
                heard_s = time.monotonic()
                printed += _print(line, item)
                stop.wait(1.0 / rate_hz if rate_hz else 0.0)
                _only_newest(inbox, rate_hz)
            elif timeout_s and time.monotonic() - heard_s > timeout_s:
                sys.stderr.write(f"softloop: nothing on '{text}' for {timeout_s:g} s\n")
                return EXIT_LOST
    return EXIT_OK


def _print(line: Callable[[str, bytes], str], item: tuple[str, bytes]) -> int:
    """How many messages were printed."""
    try:
        print(line(*item), flush=True)
    except BadPayload as error:
        sys.stderr.write(f"softloop: {error}\n")
        return 0
    return 1


def _only_newest(inbox: Inbox, rate_hz: float | None) -> None:
    """With `--rate`, what came meanwhile is left out, so that the next line is fresh."""
    if rate_hz:
        inbox.take_all()
