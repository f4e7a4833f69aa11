"""Received CAN frames between the thread that brings them and the one that takes them."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable

import can

from softloop.wire.can_frame import CanFrame


class FrameQueue:
    """Frames that wait to be received: bounded, the oldest go first; an event descriptor is readable while some wait."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._frames: deque[CanFrame] = deque()
        self._ready = threading.Condition()
        self._event_fd = -1
        self._closed = False
        self.dropped = 0

    def put(self, frame: CanFrame) -> None:
        with self._ready:
            if self._closed:
                return
            if len(self._frames) >= self._capacity:
                self._frames.popleft()
                self.dropped += 1
            self._frames.append(frame)
            self._ready.notify()
            if self._event_fd >= 0 and len(self._frames) == 1:
                os.eventfd_write(self._event_fd, 1)

    def take(self, timeout_s: float | None) -> CanFrame | None:
        """The oldest frame, waiting up to `timeout_s` (None: for ever). Raises CanOperationError once closed."""
        with self._ready:
            if not self._frames and not self._closed and (timeout_s is None or timeout_s > 0):
                self._ready.wait_for(lambda: self._frames or self._closed, timeout_s)
            if self._closed:
                raise can.CanOperationError("the bus is shut down")
            if not self._frames:
                return None
            frame = self._frames.popleft()
            self._clear_event_when_empty()
            return frame

    def keep_only(self, wanted: Callable[[CanFrame], bool]) -> None:
        """Throw away all waiting frames that are not wanted (any more)."""
        with self._ready:
            self._frames = deque(filter(wanted, self._frames))
            self._clear_event_when_empty()

    def _clear_event_when_empty(self) -> None:
        if self._event_fd >= 0 and not self._frames:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._event_fd)

    def fileno(self) -> int:
        """The event descriptor, made at the first call. Raises CanOperationError once closed."""
        with self._ready:
            if self._closed:
                raise can.CanOperationError("the bus is shut down")
            if self._event_fd < 0:
                self._event_fd = os.eventfd(1 if self._frames else 0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
            return self._event_fd

    def close(self) -> None:
        """End all waits, now and later."""
        with self._ready:
            self._closed = True
            self._ready.notify_all()
            if self._event_fd >= 0:
                os.close(self._event_fd)
                self._event_fd = -1
