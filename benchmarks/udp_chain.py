"""The rig's five hops by bare UDP sockets: source -> adapter -> controller (5 ms ticks) -> gate -> driver.

One process per hop, on loopback, each with the priority the rig's processes get. A datagram carries the stamps of all hops it
has passed. This is what the loop costs with nothing but the kernel and Python in it.
"""

from __future__ import annotations

import os
import socket
import struct
import subprocess
import sys
import time
from io import BytesIO

import numpy as np
from numpy.typing import NDArray

PERIOD_NS = 5_000_000
HOST = "127.0.0.1"
STAMPS = ("sent", "adapter_in", "adapter_out", "woken", "controller_out", "gate_in", "gate_out", "driver_in")
_LIMIT_S = 30.0  # over and above the run's own length a hop may live


def bound_socket() -> socket.socket:
    """A UDP socket on a port the system chose."""
    end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    end.bind((HOST, 0))
    return end


def take_priority(priority: int) -> None:
    """SCHED_FIFO where permitted, as the rig's processes do."""
    if priority:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except PermissionError:
            sys.stderr.write("udp chain: no real-time priority\n")


def relay(end: socket.socket, to: int, until_ns: int) -> None:
    """Adapter and gate: pass each datagram on with two stamps added."""
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    end.settimeout(0.5)
    while time.monotonic_ns() < until_ns:
        try:
            data = end.recv(256)
        except TimeoutError:
            continue
        arrived = time.monotonic_ns()
        out.sendto(data + struct.pack("<qq", arrived, time.monotonic_ns()), (HOST, to))


def controller(end: socket.socket, to: int, until_ns: int) -> None:
    """Every 5 ms the newest datagram goes on, with the time of waking and of sending; prints lateness at the end."""
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    end.setblocking(False)
    deadline = time.monotonic_ns() + PERIOD_NS
    late = []
    while deadline < until_ns:
        time.sleep(max(0, deadline - time.monotonic_ns()) * 1e-9)
        woken = time.monotonic_ns()
        late.append(woken - deadline)
        newest = None
        while True:
            try:
                newest = end.recv(256)
            except BlockingIOError:
                break
        if newest is not None:
            out.sendto(newest + struct.pack("<qq", woken, time.monotonic_ns()), (HOST, to))
        deadline += PERIOD_NS * (1 + max(0, time.monotonic_ns() - deadline - PERIOD_NS) // PERIOD_NS)
    np.save(sys.stdout.buffer, np.array(late))


def driver(end: socket.socket, until_ns: int) -> None:
    """Stamp and keep; the table of stamps goes to standard output at the end."""
    end.settimeout(0.5)
    rows = []
    while time.monotonic_ns() < until_ns:
        try:
            data = end.recv(256)
        except TimeoutError:
            continue
        rows.append((*struct.unpack(f"<{len(data) // 8}q", data), time.monotonic_ns()))
    np.save(sys.stdout.buffer, np.array(rows, dtype=np.int64).reshape(-1, len(STAMPS)))


def source(to: int, until_ns: int) -> None:
    """A datagram every 5 ms, on a clock of its own (100 ppm fast, as the inclinometer's may be)."""
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    deadline = time.monotonic_ns()
    while deadline < until_ns:
        time.sleep(max(0, deadline - time.monotonic_ns()) * 1e-9)
        out.sendto(struct.pack("<q", time.monotonic_ns()), (HOST, to))
        deadline += PERIOD_NS - 500


def main() -> None:
    """One hop: `python udp_chain.py ROLE FD TO UNTIL_NS PRIORITY`."""
    role, fd, to, until_ns, priority = sys.argv[1], *map(int, sys.argv[2:6])
    take_priority(priority)
    end = socket.socket(fileno=fd)
    if role == "source":
        source(to, until_ns)
    elif role == "relay":
        relay(end, to, until_ns)
    elif role == "controller":
        controller(end, to, until_ns)
    elif role == "driver":
        driver(end, until_ns)


def run_chain(seconds: float, priority: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Run all five for `seconds`: stamps (n, 8) in ns, and the controller's lateness (m,) in ns."""
    ends = {name: bound_socket() for name in ("source", "adapter", "controller", "gate", "driver")}
    ports = {name: end.getsockname()[1] for name, end in ends.items()}
    until_ns = time.monotonic_ns() + round(seconds * 1e9)
    plan = (
        ("driver", "driver", 0),
        ("relay", "gate", ports["driver"]),
        ("controller", "controller", ports["gate"]),
        ("relay", "adapter", ports["controller"]),
        ("source", "source", ports["adapter"]),
    )
    running = {name: _start(role, ends[name], to, until_ns, priority) for role, name, to in plan}
    try:
        outputs = {name: process.communicate(timeout=seconds + _LIMIT_S)[0] for name, process in running.items()}
    finally:
        for process in running.values():
            if process.poll() is None:
                process.kill()
        for end in ends.values():
            end.close()
    return _load(outputs["driver"]), _load(outputs["controller"])


def _start(role: str, end: socket.socket, to: int, until_ns: int, priority: int) -> subprocess.Popen[bytes]:
    command = [sys.executable, __file__, role, str(end.fileno()), str(to), str(until_ns), str(priority)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, pass_fds=(end.fileno(),))


def _load(data: bytes) -> NDArray[np.int64]:
    loaded: NDArray[np.int64] = np.load(BytesIO(data))
    return loaded


if __name__ == "__main__":
    main()
