"""A bench file with a meeting point of its own, and somebody who speaks on it."""

import threading
import time
from contextlib import contextmanager

from softloop.deploy.bench import load_bench
from softloop.wire.channels import CHANNELS, can_key, key
from softloop.wire.messages import message
from softloop.wire.session import open_router, open_wire

BY_NAME = {c.name: c for c in CHANNELS}


def write_bench(folder, name, more=""):
    """A bench of a gate and what it needs; its sockets in `folder`, whose path must be short."""
    file = folder / "b.toml"
    file.write_text(
        f'name = "{name}"\n[zenoh]\nendpoint = "unixsock-stream/{folder}/m.sock"\n[host]\nrealtime_priority = 0\n'
        f'[can.can0]\n[valves]\n[pressures]\n[inclinometer]\nport = "/dev/null"\n[controller]\n{more}'
    )
    return file


class Speaker:
    """Publishes messages on a bench."""

    def __init__(self, bench, wire):
        self.bench, self.wire = bench, wire

    def say(self, channel, **values):
        kind = message(BY_NAME[channel].message)
        self.wire.session.put(key(self.bench.name, BY_NAME[channel]), kind.pack(kind.make(**values)))

    def frame(self, bus, arbitration_id, **values):
        kind = message("CanFrame")
        self.wire.session.put(can_key(self.bench.name, bus, arbitration_id), kind.pack(kind.make(**values)))


@contextmanager
def speaking(file):
    """A router of the bench in `file`, and a `Speaker`."""
    bench = load_bench(file)
    with open_router(bench.zenoh, bench.name), open_wire(bench.zenoh, bench.name, "speaker") as wire:
        wire.settle(lambda: False)
        yield Speaker(bench, wire)


@contextmanager
def repeating(turn, every_s=0.005):
    """Calls `turn(i)` again and again in a thread while the block runs."""
    stop = threading.Event()

    def loop():
        i = 0
        while not stop.is_set():
            turn(i)
            i += 1
            time.sleep(every_s)

    thread = threading.Thread(target=loop, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(10)
