"""`softloop foxglove`: a running bench for Foxglove and Lichtblick."""

from __future__ import annotations

import time
from importlib import resources
from pathlib import Path

from softloop.deploy.bench import find_bench, load_bench
from softloop.deploy.signals import stop_on_signals
from softloop.watch.foxglove import Bridge, serve
from softloop.watch.guest import guest_wire
from softloop.wire.errors import EXIT_OK, BadFile
from softloop.wire.mcap_layout import read_origin

LAYOUT = "foxglove_layout.json"
BENCH_IN_LAYOUT = "/softloop/sim/"


def foxglove(bench_file: Path, port: int | None) -> int:
    """Serve until Ctrl-C. Raises Unavailable when the bench is not running, the extra is missing or the port is in use."""
    bench = load_bench(find_bench(bench_file))
    config = bench.foxglove if port is None else bench.foxglove.model_copy(update={"port": port})
    with stop_on_signals() as stop, guest_wire(bench.zenoh, bench.name, "foxglove") as wire:
        bridge = Bridge(config, read_origin(bench.name, time.monotonic_ns()))
        serve(bridge, wire, stop, lambda address: print(f"Foxglove: {address}", flush=True))
    return EXIT_OK


def write_layout(bench_file: Path, target: Path) -> int:
    """Write the shipped layout with the topics of a bench. Raises BadFile when it cannot be written."""
    bench = load_bench(find_bench(bench_file))
    text = (resources.files("softloop.watch") / "files" / LAYOUT).read_text(encoding="utf-8")
    try:
        target.write_text(text.replace(BENCH_IN_LAYOUT, f"/softloop/{bench.name}/"), encoding="utf-8")
    except OSError as error:
        raise BadFile(f"{target}: cannot be written: {error.strerror or error}") from None
    print(target)
    return EXIT_OK
