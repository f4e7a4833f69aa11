"""The process shell: what every process of a rig does around its loop, written once.

Signals and the launcher's lifeline ask for a stop; the loop sees `context.stop`. Real-time priority and locked memory are
taken where the machine grants them, and a plain word says so where it does not. The garbage collector is kept out of the
loop: all that was built before it is frozen.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from softloop.wire.clock import Clock
from softloop.wire.config import HostConfig, ZenohConfig
from softloop.wire.errors import EXIT_LOST, EXIT_OK, SoftloopError
from softloop.wire.faults import NoFaults
from softloop.wire.pace import ByteSource, FrameSource, Pace
from softloop.wire.session import Wire, open_wire

if TYPE_CHECKING:
    from softloop.wire.can_port import CanPort

_MCL_CURRENT_FUTURE_ONFAULT = 1 | 2 | 4  # sys/mman.h; on fault: lock what is touched, not all that is mapped


class Stop:
    """A request to end, with its reason; set by a signal, the lifeline or the loop itself.

    A signal's handler runs amid what the main thread does, and that may be `wait`. So nothing in here holds a lock that `set`
    needs (a `threading.Event` does, for a moment in each wait: a handler that comes then waits for its own thread for ever).
    """

    def __init__(self) -> None:
        self._asked = False
        self._door = threading.Lock()  # held until the request; who waits waits for it
        self._door.acquire()
        self.reason = ""

    def set(self, reason: str) -> None:
        if self._asked:
            return
        self.reason = reason
        self._asked = True
        self._open()

    def _open(self) -> None:
        with contextlib.suppress(RuntimeError):  # two at once: it is open already
            self._door.release()

    def __bool__(self) -> bool:
        return self._asked

    def wait(self, timeout_s: float) -> bool:
        if not self._asked and self._door.acquire(timeout=max(0.0, timeout_s)):
            self._open()  # for the next who waits
        return self._asked


@dataclass
class Context:
    """What a process is given besides its own config."""

    process: str
    bench: str
    run_dir: Path
    wire: Wire
    pace: Pace = field(default_factory=Pace)
    stop: Stop = field(default_factory=Stop)
    realtime: bool = False
    on_begin: list[Callable[[], None]] = field(default_factory=list)
    faults: NoFaults = field(default_factory=NoFaults)
    event_numbers: Iterator[int] = field(default_factory=lambda: count(1))

    @property
    def clock(self) -> Clock:
        """The rig clock."""
        return self.pace.clock

    def frames(self, port: CanPort, wire: int) -> FrameSource:
        """The frames of one of the rig's wires (WIRE_*), at this run's pace and with the faults injected into it."""
        return self.faults.frames(self.pace.frames(port, wire), port, wire)

    def bytes(self, source: ByteSource, wire: int) -> ByteSource:
        """Likewise the bytes."""
        return self.faults.bytes(self.pace.bytes(source, wire), wire)

    def enter_loop(self) -> None:
        """Everything is built and warm: keep the collector out, show that this process is alive, and begin with the others.

        Nothing is published before: what is to be said first waits in `on_begin`.
        """
        gc.collect()
        gc.freeze()
        gc.disable()
        self.wire.declare_alive()
        self.pace.begin()
        for say_first in self.on_begin:
            say_first()


def say(process: str, text: str) -> None:
    """One line for a person, on standard error."""
    sys.stderr.write(f"[{process}] {text}\n")
    sys.stderr.flush()


def run_process(
    process: str,
    body: Callable[[Context], None],
    *,
    bench: str,
    zenoh: ZenohConfig,
    host: HostConfig,
    run_dir: Path,
    lifeline_fd: int | None = None,
    realtime: bool = True,
    pace_of: Callable[[Wire, Stop], Pace] = lambda wire, stop: Pace(),
) -> int:
    """Run a process's body inside the shell; returns its exit code. A fault ends in one line, never a traceback."""
    stop = Stop()
    _catch_signals(stop)
    if lifeline_fd is not None:
        watch_lifeline(lifeline_fd, stop)
    granted = realtime and prefer_realtime(process, host)
    sys.setswitchinterval(5e-4)  # a waiting 5 ms loop gets the interpreter back soon after a Zenoh callback took it
    try:
        with open_wire(zenoh, bench, process) as wire:
            wire.settle(lambda: bool(stop))
            context = Context(process, bench, run_dir, wire, pace_of(wire, stop), stop, granted)
            body(context)
            context.pace.finish()
    except SoftloopError as error:
        say(process, str(error))
        return error.exit_code
    except Exception as error:  # noqa: BLE001 - the shell is the last frame: one line, and the trace to a file
        say(process, f"stopped by a fault of its own: {error!r}; see {_keep_trace(process, run_dir)}")
        return EXIT_LOST
    return EXIT_OK


def _keep_trace(process: str, run_dir: Path) -> Path:
    file = run_dir / f"{process}.trace.txt"
    file.write_text(traceback.format_exc())
    return file


def _catch_signals(stop: Stop) -> None:
    def on_signal(number: int, _frame: FrameType | None) -> None:
        stop.set(signal.Signals(number).name)

    signal.signal(signal.SIGTERM, on_signal)
    signal.signal(signal.SIGINT, on_signal)


def watch_lifeline(fd: int, stop: Stop) -> None:
    """The launcher holds the other end of this pipe and never writes: its end of file means that the launcher is gone."""

    def wait_for_end() -> None:
        os.read(fd, 1)
        stop.set("lifeline closed")

    threading.Thread(target=wait_for_end, name="lifeline", daemon=True).start()


def prefer_realtime(process: str, host: HostConfig) -> bool:
    """Take SCHED_FIFO and lock memory where permitted, before any thread starts; True when the priority was granted."""
    if host.realtime_priority == 0:
        return False
    if host.lock_memory and ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT_FUTURE_ONFAULT) != 0:
        say(process, f"memory is not locked ({os.strerror(ctypes.get_errno())}); see docs/real-time.md")
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(host.realtime_priority))
    except PermissionError:
        say(process, "no real-time priority (not permitted); ticks may come late under load, see docs/real-time.md")
        return False
    return True
