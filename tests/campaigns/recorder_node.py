"""A recorder in a process of its own, for the kill campaign; arguments: endpoint, folder, name, limit of file size or 0.

Its standard input is its lifeline: it ends when the campaign does, however that ends.
"""

import resource
import signal
import sys
from pathlib import Path

from softloop.watch.config import RecorderConfig
from softloop.watch.recorder import run
from softloop.wire.config import ZenohConfig
from softloop.wire.session import open_wire
from softloop.wire.shell import Context, Stop, watch_lifeline

BENCH = "kill"


def main(endpoint, run_dir, name, limit_bytes):
    stop = Stop()
    signal.signal(signal.SIGTERM, lambda *_: stop.set("SIGTERM"))
    watch_lifeline(sys.stdin.fileno(), stop)
    if int(limit_bytes):
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(limit_bytes), resource.RLIM_INFINITY))
    with open_wire(ZenohConfig(mode="client", lease_ms=20_000, endpoint=endpoint), BENCH, name) as wire:
        run(RecorderConfig(), Context(name, BENCH, Path(run_dir), wire, stop=stop))


if __name__ == "__main__":
    main(*sys.argv[1:])
