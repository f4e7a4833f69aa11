"""The cables between the hosts: every packet that the kernel routes into a TUN device goes through a `Cable` and comes back.

    python -m tests.net.relay --tun cable0 --delay-ms 1 --jitter-ms 0.2 --loss 0.01 --seed 1 --json FILE

Runs in the namespace that all hosts' links end in (`lab.py`), which routes what comes from a host into this device and what comes
out of it to the other host. Ends on SIGTERM or Ctrl-C and leaves its counts in FILE: per direction, what was lost, and how late
the others came out after they were due, which is this relay's own error.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import json
import os
import select
import signal
import socket
import struct
import sys
import time
from pathlib import Path
from typing import Any

from tests.net.cable import Cable, Way

TUNSETIFF = 0x400454CA
IFF_TUN, IFF_NO_PI = 0x0001, 0x1000
PACKET_BYTES = 65_536
IPV4 = 4
PRIORITY = 60  # above the rig's own: a wire does not wait for a processor


def open_tun(name: str) -> int:
    """A TUN device of this network namespace, whole IP packets, not blocking; gone when the descriptor closes."""
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH22x", name.encode(), IFF_TUN | IFF_NO_PI))
    return device


def direction_of(packet: bytes) -> str | None:
    """`10.0.1.2>10.0.2.2` of an IPv4 packet, None of anything else."""
    if len(packet) < 20 or packet[0] >> 4 != IPV4:
        return None
    return f"{socket.inet_ntoa(packet[12:16])}>{socket.inet_ntoa(packet[16:20])}"


class Relay:
    """All directions of one device. Packets of no direction (IPv6 of the kernel's own) are dropped."""

    def __init__(self, way: Way, seed: int) -> None:
        self.way, self.seed = way, seed
        self.cables: dict[str, Cable] = {}
        self.late_ns: list[int] = []

    def put(self, packet: bytes, now_ns: int) -> None:
        direction = direction_of(packet)
        if direction is None:
            return
        if direction not in self.cables:
            self.cables[direction] = Cable(self.way, self.seed, direction)
        self.cables[direction].put(packet, now_ns)

    @property
    def next_ns(self) -> int | None:
        return min((cable.next_ns for cable in self.cables.values() if cable.next_ns is not None), default=None)

    def take(self, now_ns: int) -> list[tuple[int, bytes]]:
        return [out for cable in self.cables.values() for out in cable.take(now_ns)]

    def counts(self) -> dict[str, Any]:
        """What happened so far."""
        late = sorted(self.late_ns)
        parts = {"p50": 0.5, "p99": 0.99, "p99_9": 0.999, "max": 1.0}
        return {
            "late_us": {name: late[min(len(late) - 1, int(part * len(late)))] / 1e3 for name, part in parts.items()}
            if late
            else {},
            "directions": {
                name: {"put_in": c.put_in, "lost": c.lost, "overrun": c.overrun, "passed": c.passed}
                for name, c in self.cables.items()
            },
        }


def carry(device: int, relay: Relay, ended: list[int]) -> None:
    """Carry packets until `ended` is not empty."""
    while not ended:
        due_ns = relay.next_ns
        wait_s = 0.2 if due_ns is None else max(0.0, (due_ns - time.monotonic_ns()) * 1e-9)
        ready, _, _ = select.select([device], [], [], min(wait_s, 0.2))  # select alone counts in microseconds
        if ready:
            read_all(device, relay)
        for due_ns, packet in relay.take(time.monotonic_ns()):
            with contextlib.suppress(BlockingIOError):
                os.write(device, packet)
            relay.late_ns.append(time.monotonic_ns() - due_ns)


def read_all(device: int, relay: Relay) -> None:
    for _ in range(64):  # then those that are due have their turn
        try:
            packet = os.read(device, PACKET_BYTES)
        except BlockingIOError:
            return
        relay.put(packet, time.monotonic_ns())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--tun", default="cable0")
    parser.add_argument("--delay-ms", type=float, default=0.0)
    parser.add_argument("--jitter-ms", type=float, default=0.0)
    parser.add_argument("--loss", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    ended: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, _frame: ended.append(number))
    device = open_tun(options.tun)
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    relay = Relay(Way(options.delay_ms, options.jitter_ms, options.loss), options.seed)
    sys.stdout.write(f"relay on {options.tun}\n")
    sys.stdout.flush()
    carry(device, relay, ended)
    if options.json:
        options.json.write_text(json.dumps(relay.counts()))


if __name__ == "__main__":
    main()
