"""`pty:///path/link`: a serial port made here. The opener holds one end; the path names the other, as a device would."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import socket
import struct
import termios
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import serial

_GET_NUMBER = 0x80045430  # TIOCGPTN of asm-generic/ioctls.h, which the module termios lacks
_UNLOCK = 0x40045431  # TIOCSPTLCK


class Serial(serial.Serial):  # type: ignore[misc]  # pyserial has no types
    """The opener's end of a pseudo-terminal whose other end stands at the path of the URL.

    The link is made at open and removed at close. A link left by a process that was killed is replaced; one in use, and
    anything else at that path, is refused with SerialException.

    A write never waits: when nobody reads at the other end and the kernel's buffer (about 16 kB) is full, the old bytes in
    it are thrown away, as they would be lost on a wire; `overflows` counts such moments. Baud rate, parity and modem lines are
    accepted and have no effect.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.overflows = 0
        self._link: Path | None = None
        self._slave_fd = -1
        self._slave_name = ""
        self._claim: socket.socket | None = None
        super().__init__(*args, **kwargs)

    def open(self) -> None:
        """Make the pair and the link. Raises SerialException with one line that says what is in the way."""
        if self.is_open:
            raise serial.SerialException("the port is already open")
        link = _path_of(self._port)
        self._exclusive = None  # it would lock /dev/ptmx, which all pseudo-terminals share
        self._claim = _claim(link)
        try:
            self.portstr = "/dev/ptmx"  # opening it makes a new pair
            super().open()
            self._make_other_end(link)
        except BaseException:
            self.close()
            self._let_go()
            raise
        finally:
            self.portstr = self._port

    def _make_other_end(self, link: Path) -> None:
        fcntl.ioctl(self.fd, _UNLOCK, struct.pack("i", 0))
        number = struct.unpack("I", fcntl.ioctl(self.fd, _GET_NUMBER, bytes(4)))[0]
        self._slave_name = f"/dev/pts/{number}"
        # Held open here too: without anybody there, reads on our end would fail instead of finding nothing.
        self._slave_fd = os.open(self._slave_name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        _place_link(link, self._slave_name)
        self._link = link

    def close(self) -> None:
        """Close this end and remove the link."""
        was_open = self.is_open
        super().close()
        if was_open:
            self._let_go()

    def _let_go(self) -> None:
        if self._link is not None:
            with contextlib.suppress(OSError):
                if os.readlink(self._link) == self._slave_name:
                    self._link.unlink()
            self._link = None
        if self._slave_fd >= 0:
            os.close(self._slave_fd)
            self._slave_fd = -1
        if self._claim is not None:
            self._claim.close()
            self._claim = None

    def write(self, data: Any) -> int:
        """Hand all bytes to the wire, at once. Returns their number. Raises SerialException when the port is closed."""
        if not self.is_open:
            raise serial.PortNotOpenError
        payload = serial.to_bytes(data)
        left = payload[self._put(payload) :]
        if left:
            self.overflows += 1
            termios.tcflush(self.fd, termios.TCOFLUSH)  # the kernel has two buffers on the way to the reader
            termios.tcflush(self._slave_fd, termios.TCIFLUSH)
            self._put(left)
        return len(payload)

    def _put(self, data: bytes) -> int:
        done = 0
        with contextlib.suppress(BlockingIOError):
            while done < len(data):
                done += os.write(self.fd, data[done:])
        return done

    def flush(self) -> None:
        """Nothing to wait for: what was written is at the other end or lost."""

    def _update_rts_state(self) -> None:
        """A pseudo-terminal has no modem lines."""

    def _update_dtr_state(self) -> None:
        """A pseudo-terminal has no modem lines."""

    def _update_break_state(self) -> None:
        """A pseudo-terminal has no modem lines."""

    cts = dsr = cd = property(lambda self: True)
    ri = property(lambda self: False)


def _path_of(url: str | None) -> Path:
    parts = urlsplit(url or "")
    path = Path(parts.path)
    if parts.scheme != "pty" or parts.netloc or parts.query or not path.is_absolute() or path == Path("/"):
        raise serial.SerialException(f"{url}: expected pty:///path/of/link, with an absolute path")
    if not path.parent.is_dir():
        raise serial.SerialException(f"{url}: there is no folder {path.parent}")
    return path


def _claim(link: Path) -> socket.socket:
    """A mark that this path is in use, which the kernel removes however its owner ends: an abstract Unix socket's name."""
    place = os.path.join(os.path.realpath(link.parent), link.name)
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        claim.bind("\0softloop-pty-" + hashlib.sha256(os.fsencode(place)).hexdigest())
    except OSError:
        claim.close()
        raise serial.SerialException(f"pty://{link}: another process holds this port") from None
    return claim


def _place_link(link: Path, target: str) -> None:
    if link.is_symlink():
        if not os.readlink(link).startswith("/dev/pts/"):
            raise serial.SerialException(f"pty://{link}: there is a link to something else; remove it or use another path")
    elif link.exists():
        raise serial.SerialException(f"pty://{link}: there is a file with this name; remove it or use another path")
    fresh = link.with_name(f".{link.name}.{os.getpid()}")
    try:
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(target)
        fresh.replace(link)
    except OSError as error:
        raise serial.SerialException(f"pty://{link}: cannot be made: {error.strerror}") from None
