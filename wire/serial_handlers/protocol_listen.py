"""`listen://127.0.0.1:PORT`: a serial port as a TCP server, the counterpart of pyserial's `socket://HOST:PORT`."""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import socket
import struct
import termios
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

import serial

_STALE_AT_MOST = 65536  # bytes of a client that left, kept while the next one is let in
_SEND_BUFFER = 16384  # as a pseudo-terminal has; TCP's own grows to megabytes, minutes of old bytes for a reader that comes back
_GONE = select.EPOLLRDHUP | select.EPOLLHUP | select.EPOLLERR


class Serial(serial.SerialBase):  # type: ignore[misc]  # pyserial has no types
    """Accepts one TCP connection at a time; the next may come when it is gone. Others are closed at once.

    Bytes written while nobody is connected, or while the client does not read, are lost and counted in `lost_bytes`; a
    write never waits. `fileno()` is readable while bytes or a new client wait. Port 0 takes a free one: `bound_port` and
    `client_url` tell which.
    """

    is_open: bool

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.lost_bytes = 0
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        self._events: select.epoll | None = None
        self._abort: tuple[int, int] = (-1, -1)
        self._left_over = bytearray()
        super().__init__(*args, **kwargs)

    def open(self) -> None:
        """Listen. Raises SerialException with one line that says what is in the way."""
        if self.is_open:
            raise serial.SerialException("the port is already open")
        host, number = _address_of(self._port)
        self._listener = _listen(host, number, self._port)
        self._events = select.epoll()
        self._events.register(self._listener, select.EPOLLIN)
        self._abort = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self.is_open = True

    def close(self) -> None:
        """Stop listening and close the connection."""
        if not self.is_open:
            return
        self.is_open = False
        self._drop_client()
        if self._listener is not None:
            self._listener.close()
        if self._events is not None:
            self._events.close()
        for fd in self._abort:
            os.close(fd)
        self._left_over.clear()

    @property
    def bound_port(self) -> int:
        """The TCP port it listens on."""
        self._require_open()
        assert self._listener is not None
        return int(self._listener.getsockname()[1])

    @property
    def client_url(self) -> str:
        """What the other side opens: `socket://HOST:PORT`."""
        self._require_open()
        assert self._listener is not None
        return f"socket://{self._listener.getsockname()[0]}:{self.bound_port}"

    @property
    def connected(self) -> bool:
        """Whether a client is there."""
        self._serve()
        return self._client is not None

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read now."""
        self._serve()
        waiting = len(self._left_over)
        if self._client is not None:
            waiting += struct.unpack("I", fcntl.ioctl(self._client, termios.FIONREAD, bytes(4)))[0]
        return waiting

    def read(self, size: int = 1) -> bytes:
        """Up to `size` bytes, waiting no longer than the port's timeout; fewer when it passed or `cancel_read` was called."""
        self._require_open()
        timeout = serial.serialutil.Timeout(self._timeout)
        found = bytearray()
        while True:
            found += self._read_now(size - len(found))
            if len(found) >= size or timeout.expired() or self._wait(timeout.time_left()):
                return bytes(found)

    def _read_now(self, size: int) -> bytes:
        self._serve()
        taken = bytes(self._left_over[:size])
        del self._left_over[:size]
        if self._client is None or len(taken) >= size:
            return taken
        try:
            more = self._client.recv(size - len(taken))
        except BlockingIOError:
            return taken
        except OSError:
            more = b""
        if not more:
            self._drop_client()
        return taken + more

    def _wait(self, seconds: float | None) -> bool:
        """Wait until something happens; True when the read was cancelled."""
        poll = select.poll()
        poll.register(self.fileno(), select.POLLIN)
        poll.register(self._abort[0], select.POLLIN)
        ready = [fd for fd, _ in poll.poll(None if seconds is None else seconds * 1e3)]
        if self._abort[0] in ready:
            os.read(self._abort[0], 64)
            return True
        return False

    def write(self, data: Any) -> int:
        """Send all bytes, at once, or lose them. Returns their number. Raises SerialException when the port is closed."""
        self._require_open()
        payload = serial.to_bytes(data)
        self._serve()
        sent = 0
        if self._client is not None:
            try:
                sent = self._client.send(payload)
            except BlockingIOError:
                pass
            except OSError:
                self._drop_client()
        self.lost_bytes += len(payload) - sent
        return len(payload)

    def _serve(self) -> None:
        """Let the next client in, and see the present one go."""
        self._require_open()
        assert self._events is not None
        events = dict(self._events.poll(0))
        if self._client is not None and events.get(self._client.fileno(), 0) & _GONE:
            self._keep_what_it_sent()
        assert self._listener is not None
        if self._listener.fileno() in events:
            with contextlib.suppress(OSError):
                self._let_in(self._listener.accept()[0])

    def _let_in(self, client: socket.socket) -> None:
        if self._client is not None:
            client.close()
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        assert self._events is not None
        self._events.register(client, select.EPOLLIN | select.EPOLLRDHUP)
        self._client = client

    def _keep_what_it_sent(self) -> None:
        with contextlib.suppress(OSError):
            while self._client is not None and len(self._left_over) < _STALE_AT_MOST:
                more = self._client.recv(4096)
                if not more:
                    break
                self._left_over += more
        self._drop_client()

    def _drop_client(self) -> None:
        if self._client is not None:
            self._client.close()  # this takes it out of the epoll set
            self._client = None

    def fileno(self) -> int:
        """A descriptor that is readable while bytes, a new client or a client's end wait."""
        self._require_open()
        assert self._events is not None
        return self._events.fileno()

    def cancel_read(self) -> None:
        """End a `read` that waits in another thread."""
        if self.is_open:
            os.write(self._abort[1], b"x")

    def cancel_write(self) -> None:
        """A write never waits."""

    def flush(self) -> None:
        """Nothing to wait for: what was written is sent or lost."""

    def reset_input_buffer(self) -> None:
        """Throw away what was received and not read."""
        while self.in_waiting:
            self._read_now(self.in_waiting)

    def reset_output_buffer(self) -> None:
        """Nothing is kept to be sent."""

    def _require_open(self) -> None:
        if not self.is_open:
            raise serial.PortNotOpenError

    def _reconfigure_port(self) -> None:
        """TCP has no baud rate."""

    def _update_rts_state(self) -> None:
        """TCP has no modem lines."""

    def _update_dtr_state(self) -> None:
        """TCP has no modem lines."""

    def _update_break_state(self) -> None:
        """TCP has no modem lines."""

    cts = dsr = cd = property(lambda self: True)
    ri = property(lambda self: False)


def _address_of(url: str | None) -> tuple[str, int]:
    parts = urlsplit(url or "")
    try:
        number = parts.port
    except ValueError:
        number = None
    if parts.scheme != "listen" or not parts.hostname or number is None or parts.path or parts.query:
        raise serial.SerialException(
            f"{url}: expected listen://HOST:PORT with a port from 0 to 65535, as listen://127.0.0.1:7000"
        )
    if not _is_loopback(parts.hostname):
        raise serial.SerialException(f"{url}: would listen off this machine, where nothing secures it; use 127.0.0.1")
    return parts.hostname, number


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def _listen(host: str, number: int, url: str | None) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port just left may be taken again at once
    try:
        listener.bind((host, number))
        listener.listen(1)
    except OSError as error:
        listener.close()
        raise serial.SerialException(f"{url}: cannot listen: {error.strerror or error}") from None
    listener.setblocking(False)
    return listener
