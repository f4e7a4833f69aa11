"""Bytes from any serial port as they come, and the WT931's settings written to it and read back."""

from __future__ import annotations

import os
import select
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from softloop.devices.config import InclinometerConfig
from softloop.devices.protocols import wt931
from softloop.wire.clock import Clock
from softloop.wire.errors import Lost, Unavailable
from softloop.wire.serial_urls import open_serial

WRITE_TIMEOUT_S = 0.5
_COMMAND_PAUSE_NS = 100_000_000  # the vendor's SDK leaves as much between two commands
_ANSWER_NS = 300_000_000
_ATTEMPTS = 3
_NAMES = {wt931.RSW: "RSW", wt931.RRATE: "RRATE", wt931.BANDWIDTH: "BANDWIDTH", wt931.AXIS6: "AXIS6", wt931.BAUD: "BAUD"}


class SerialSource:
    """A serial port read in the pieces in which bytes come: when a piece came tells which bytes belong together."""

    def __init__(self, url: str, baud: int) -> None:
        """Open the port. Raises Unavailable."""
        self.url = url
        self._port = open_serial(url, baud, WRITE_TIMEOUT_S)
        self._fd = _plain_descriptor(self._port)

    def read(self, timeout_s: float) -> bytes:
        """What is there, waiting up to `timeout_s` for something. Raises Lost when the port is gone."""
        try:
            return self._read_other(timeout_s) if self._fd < 0 else self._read_fd(timeout_s)
        except (OSError, ValueError) as error:
            raise Lost(f"serial port {self.url} is lost: {error}") from None

    def _read_fd(self, timeout_s: float) -> bytes:
        poll = select.poll()
        poll.register(self._fd, select.POLLIN)
        if not poll.poll(timeout_s * 1e3):
            return b""
        try:
            data = os.read(self._fd, 4096)
        except BlockingIOError:
            return b""
        if not data:
            raise OSError("its other end is closed")
        return data

    def _read_other(self, timeout_s: float) -> bytes:
        if self._port.timeout != timeout_s:
            self._port.timeout = timeout_s
        data: bytes = self._port.read(1)
        waiting = self._port.in_waiting if data else 0
        return data + self._port.read(waiting) if waiting else data

    def write(self, data: bytes) -> None:
        """Send all bytes. Raises Lost."""
        try:
            self._port.write(data)
        except (OSError, ValueError) as error:
            raise Lost(f"serial port {self.url} is lost: {error}") from None

    def close(self) -> None:
        self._port.close()


def _plain_descriptor(port: Any) -> int:
    """A descriptor whose `os.read` gives the port's bytes, or -1."""
    try:
        fd = int(port.fileno())
        mode = os.fstat(fd).st_mode
    except (AttributeError, OSError, ValueError):
        return -1
    return fd if stat.S_ISCHR(mode) or stat.S_ISSOCK(mode) else -1


def configure(config: InclinometerConfig, clock: Clock) -> dict[str, int]:
    """Write the settings of the bench file to the device, let it keep them, and check that it took them.

    Returns:
        What each register held when it was read back at the end, by its name.

    Raises:
        Unavailable: the port cannot be opened, or the device does not answer or does not hold what was written.
        Lost: the port went away.
    """
    old_baud = config.configure_baud or config.baud
    settings = wt931.settings(config.rate_hz, config.bandwidth_hz)
    with _talking(config.port, old_baud, clock) as setup:
        setup.write_settings(settings, config.baud)
    # Some devices change their baud rate with the write and some with the save: what came too late for the one is said again.
    with _talking(config.port, config.baud, clock) as setup:
        setup.save()
        return setup.check(settings | {wt931.BAUD: wt931.BAUD_CODES[config.baud]})


@contextmanager
def _talking(url: str, baud: int, clock: Clock) -> Iterator[_Setup]:
    setup = _Setup(url, baud, clock)
    try:
        yield setup
    finally:
        setup.source.close()


class _Setup:
    """One conversation with the device at one baud rate."""

    def __init__(self, url: str, baud: int, clock: Clock) -> None:
        self.source, self.baud, self.clock = SerialSource(url, baud), baud, clock

    def write_settings(self, settings: dict[int, int], new_baud: int) -> None:
        for register, value in settings.items():
            self._send(wt931.encode_unlock(), wt931.encode_command(register, value))
        self.check(settings)
        self._send(wt931.encode_unlock(), wt931.encode_command(wt931.BAUD, wt931.BAUD_CODES[new_baud]))
        self.save()

    def save(self) -> None:
        self._send(wt931.encode_unlock(), wt931.encode_command(wt931.SAVE, 0))

    def check(self, settings: dict[int, int]) -> dict[str, int]:
        return {_NAMES[register]: self._checked(register, value) for register, value in settings.items()}

    def _send(self, *commands: bytes) -> None:
        for command in commands:
            self.source.write(command)
            self.clock.sleep_until_ns(self.clock.now_ns() + _COMMAND_PAUSE_NS)

    def _checked(self, register: int, value: int) -> int:
        held = self._read_back(register)
        if held != value:
            raise Unavailable(
                f"WT931 on {self.source.url}: its register {_NAMES[register]} holds {held} after {value} was written; "
                "re-power the device and try again"
            )
        return held

    def _read_back(self, register: int) -> int:
        for _ in range(_ATTEMPTS):
            parser = wt931.Parser()
            self.source.write(wt931.encode_command(wt931.READ, register))
            until_ns = self.clock.now_ns() + _ANSWER_NS
            while self.clock.now_ns() < until_ns:
                for packet in parser.feed(self.source.read(0.02)):
                    if packet.kind == wt931.REGISTERS:
                        return packet.words[0] & 0xFFFF
        raise Unavailable(
            f"WT931 on {self.source.url}: no answer at {self.baud} baud; is 'baud' or 'configure_baud' that of the device, "
            "and is it powered? A new baud rate may need a re-power"
        )
