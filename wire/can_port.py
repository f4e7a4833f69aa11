"""A CAN bus as an adapter uses it: the same frames and the same words about trouble, whatever the interface.

What an adapter has to know of trouble:

- `recv` and `send` raise `Lost` when the device is gone (unplugged, its driver reports a fault that is not one of those
  below). They never hang: a frame that the bus does not take in time is given up.
- `bus_off` is True from the moment the bus said so (an error frame, or an interface that is down) until a restart is
  reported or a frame comes in again, which a node that is off the bus could not receive. `bus_offs` counts such moments, so
  that a short one is not missed between two looks. Error frames are also returned, with FLAG_ERROR.
- `send` returns False when the frame did not get out: the queue stayed full, or the bus is off. `unsent` counts them.
- `malformed` counts what came in and was no classic CAN frame (noise on a serial adapter's line, CAN FD).
"""

from __future__ import annotations

import contextlib
import errno
import select
import threading
import time

import can
import serial
import zenoh

from softloop.wire.can_config import one_line
from softloop.wire.can_frame import FLAG_ERROR, FLAG_EXTENDED, STANDARD_IDS, CanFrame, from_message, make_frame, state_after
from softloop.wire.can_zenoh import FramePublisher, ZenohBus
from softloop.wire.clock import Clock
from softloop.wire.errors import Lost
from softloop.wire.session import Wire

_MOST_NOISE_AT_ONCE = 64
_ONLY_NOISE = 256  # faults in reading, with no frame between them: not a bad line any more, but a dead one
_CLOSE_WITHIN_S = 2.0
_DOWN = {errno.ENETDOWN, errno.ENETUNREACH}
_FULL = {errno.ENOBUFS, errno.EAGAIN, errno.ETIMEDOUT}


class CanPort:
    """Wraps a python-can bus; it closes the bus with itself.

    Frames of a bus that is not on Zenoh are stamped when they are taken, because their own timestamps are of another clock,
    and, with `mirror`, published on `softloop/<bench>/can/<name>/<id>`, so that a log has the frames of any bus. Give each
    port of one bus only the ids it needs (`open_port(..., receive=)`), and no frame is mirrored twice.
    """

    def __init__(
        self, bus: can.BusABC, name: str, wire: Wire, clock: Clock, *, send_timeout_s: float = 0.002, mirror: bool = True
    ) -> None:
        self.bus = bus
        self.name = name
        self.malformed_lines = 0
        self.unsent = 0
        self.bus_offs = 0
        self._clock = clock
        self._send_timeout_s = send_timeout_s
        self._zenoh = bus if isinstance(bus, ZenohBus) else None
        self._mirror = FramePublisher(wire.session, wire.bench, name, wire.congestion) if mirror and self._zenoh is None else None
        self._node = wire.node_on(name)
        self._seq = 0
        self._noise_run = 0
        self._state = can.BusState.ACTIVE
        self._fd = _descriptor(bus)

    @property
    def bus_off(self) -> bool:
        return self._state == can.BusState.ERROR

    @property
    def malformed(self) -> int:
        """What came in and was no classic CAN frame, in total."""
        return self.malformed_lines + (self._zenoh.malformed if self._zenoh else 0)

    def recv(self, timeout_s: float = 0.0) -> CanFrame | None:
        """The next frame, waiting up to `timeout_s`; None when none came. Raises Lost when the device is gone."""
        if self._zenoh is None:
            return self._recv_other(timeout_s)
        try:
            frame = self._zenoh.recv_frame(timeout_s)
        except can.CanError as error:
            raise Lost(self._say(error)) from None
        if frame is not None:
            self._note(frame)
        return frame

    def send(self, arbitration_id: int, data: bytes, stamp_ns: int) -> bool:
        """Send a data frame; ids from 0x800 on are extended ones. Returns whether it got out.

        Raises Lost when the device is gone, ValueError when id or data do not fit a classic frame.
        """
        flags = FLAG_EXTENDED if arbitration_id >= STANDARD_IDS else 0
        if self._zenoh is None:
            return self._send_other(arbitration_id, data, stamp_ns, flags)
        try:
            self._zenoh.send_frame(arbitration_id, data, stamp_ns, flags)
        except can.CanError as error:
            if _number(error) not in _DOWN:
                raise Lost(self._say(error)) from None
            self._go_off()
            self.unsent += 1
            return False
        return True

    def note(self, frame: CanFrame) -> None:
        """Believe a frame's word on the bus's state, as if it had come in."""
        self._note(frame)

    def close(self) -> None:
        """Leave the bus; a driver that does not let go within 2 s is left behind. May be called again."""
        ending = threading.Thread(target=self._shut_down, name=f"close {self.name}", daemon=True)
        ending.start()
        ending.join(_CLOSE_WITHIN_S)
        if self._mirror is not None:
            self._mirror.close()

    def _shut_down(self) -> None:
        with contextlib.suppress(Exception):  # a device that is gone cannot be closed in order
            self.bus.shutdown()

    def _recv_other(self, timeout_s: float) -> CanFrame | None:
        deadline = time.monotonic() + timeout_s
        for _ in range(_MOST_NOISE_AT_ONCE):
            left_s = max(0.0, deadline - time.monotonic())
            msg = self._take(left_s)
            frame = None if msg is None else self._convert(msg)
            if frame is not None:
                return frame
            if msg is None and not self._more_waits() and time.monotonic() >= deadline:
                return None
        return None

    def _take(self, timeout_s: float) -> can.Message | None:
        try:
            return self.bus.recv(timeout=timeout_s)
        except Exception as error:  # noqa: BLE001 - drivers raise what they like; it is sorted here
            if _is_noise(error) and self._noise_run < _ONLY_NOISE:
                self.malformed_lines += 1
                self._noise_run += 1
                with contextlib.suppress(Exception):
                    getattr(self.bus, "flush", lambda: None)()  # slcan keeps the bytes it could not decode
            elif _number(error) in _DOWN:
                self._go_off()
                time.sleep(timeout_s)
            else:
                raise Lost(self._say(error)) from None
        return None

    def _more_waits(self) -> bool:
        """Whether the device has more: a serial adapter's `recv` also returns at a line that is no frame."""
        if self._fd < 0:
            return False
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        return any(events & select.POLLIN for _, events in poll.poll(0))

    def _convert(self, msg: can.Message) -> CanFrame | None:
        try:
            frame = from_message(msg, self._seq + 1, self._clock.now_ns(), self._node)
        except ValueError:
            self.malformed_lines += 1
            return None
        self._seq += 1
        self._noise_run = 0
        self._note(frame)
        if msg.is_rx:  # what this port sent was published then
            self._publish(frame)
        return frame

    def _send_other(self, arbitration_id: int, data: bytes, stamp_ns: int, flags: int) -> bool:
        frame = make_frame(self._seq + 1, stamp_ns, self._node, arbitration_id, data, flags)
        msg = can.Message(arbitration_id=arbitration_id, is_extended_id=bool(flags), data=data)
        try:
            self.bus.send(msg, timeout=self._send_timeout_s)
        except Exception as error:  # noqa: BLE001 - drivers raise what they like; it is sorted here
            if _number(error) in _DOWN:
                self._go_off()
            elif not _is_full(error):
                raise Lost(self._say(error)) from None
            self.unsent += 1
            return False
        self._seq += 1
        self._publish(frame)
        return True

    def _note(self, frame: CanFrame) -> None:
        if not frame.flags & FLAG_ERROR:
            self._state = can.BusState.ACTIVE if self.bus_off else self._state
        elif state_after(self._state, frame) == can.BusState.ERROR:
            self._go_off()
        else:
            self._state = state_after(self._state, frame)

    def _go_off(self) -> None:
        self.bus_offs += not self.bus_off
        self._state = can.BusState.ERROR

    def _publish(self, frame: CanFrame) -> None:
        if self._mirror is not None:
            with contextlib.suppress(zenoh.ZError):  # the copy for the log must not stop the bus
                self._mirror.put(frame)

    def _say(self, error: BaseException) -> str:
        return f"CAN bus '{self.name}' ({self.bus.channel_info}) is lost: {one_line(error)}"


def _descriptor(bus: can.BusABC) -> int:
    try:
        return bus.fileno()
    except Exception:  # noqa: BLE001 - many drivers have none
        return -1


def _chain(error: BaseException) -> list[BaseException]:
    """An error and what caused it: python-can wraps the driver's own."""
    found: list[BaseException] = []
    current: BaseException | None = error
    while current is not None and len(found) < 8:
        found.append(current)
        current = current.__cause__
    return found


def _number(error: BaseException) -> int | None:
    numbers = [getattr(e, "error_code", None) or getattr(e, "errno", None) for e in _chain(error)]
    return next((n for n in numbers if n is not None), None)


def _is_noise(error: BaseException) -> bool:
    return any(isinstance(e, ValueError | IndexError) for e in _chain(error))


def _is_full(error: BaseException) -> bool:
    waited = any(isinstance(e, TimeoutError | serial.SerialTimeoutException) for e in _chain(error))
    return waited or _number(error) in _FULL
