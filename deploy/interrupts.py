"""Ctrl-C as Python knows it, but never in the middle of what cannot be left there.

KeyboardInterrupt comes up wherever the main thread stands. In a library that is called back from C it is printed and lost, LLVM
crashes when it comes while a kernel is loaded, and a pool whose first worker is just begun cannot be shut down any more (each
seen, with `softloop batch`). Imports, which take a second or two, are in between such moments all the time.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

NOT_IN = ("numba", "llvmlite", "importlib", "multiprocessing", "concurrent.futures.process")
AGAIN_S = 0.02  # a person does not notice, and it costs nothing


@contextmanager
def careful_interrupts() -> Iterator[None]:
    """Within, KeyboardInterrupt for SIGINT waits until the main thread has left the libraries of `NOT_IN`.

    A SIGINT that comes later to a handler of somebody else goes there; one that is ignored, as a shell has it for what it starts
    in the background, stays ignored.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    before = signal.signal(signal.SIGALRM, _try_again)
    signal.signal(signal.SIGINT, _interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _interrupt(_number: int, frame: FrameType | None) -> None:
    if can_be_left(frame):
        raise KeyboardInterrupt
    signal.setitimer(signal.ITIMER_REAL, AGAIN_S)


def _try_again(_number: int, _frame: FrameType | None) -> None:
    signal.raise_signal(signal.SIGINT)  # to whoever handles it by now


def can_be_left(frame: FrameType | None) -> bool:
    """Whether nothing from `frame` outwards is code of `NOT_IN`."""
    while frame is not None:
        name = str(frame.f_globals.get("__name__", ""))
        if any(name == one or name.startswith(f"{one}.") for one in NOT_IN):
            return False
        frame = frame.f_back
    return True
