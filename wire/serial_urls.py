"""Serial ports by URL, two kinds of which are ours.

Importing this module teaches pyserial:

- `pty:///path/link` makes a pseudo-terminal and puts its other end at the path;
- `listen://127.0.0.1:PORT` waits for a `socket://` client.
"""

from __future__ import annotations

import contextlib
from typing import Any

import serial

from softloop.wire.errors import Unavailable

HANDLERS = "softloop.wire.serial_handlers"

if HANDLERS not in serial.protocol_handler_packages:
    serial.protocol_handler_packages.append(HANDLERS)


def open_serial(url: str, baud: int, timeout_s: float) -> Any:
    """Open a serial port: a device such as /dev/ttyUSB0, or any pyserial URL.

    Args:
        baud: bit/s; without effect where there is no wire.
        timeout_s: how long a read waits, and how long a write may take.

    Returns:
        A `serial.SerialBase`. A device is locked against other openers, and asked to hand over each byte at once (USB
        adapters otherwise keep bytes back for up to 16 ms).

    Raises:
        Unavailable: one line that says why the port cannot be opened.
    """
    try:
        port = serial.serial_for_url(url, baudrate=baud, timeout=timeout_s, write_timeout=timeout_s, exclusive=True)
    except (OSError, ValueError) as error:
        raise Unavailable(f"serial port {url}: {_reason(url, error)}") from None
    with contextlib.suppress(AttributeError, ValueError, NotImplementedError, OSError):
        port.set_low_latency_mode(True)
    return port


def _reason(url: str, error: Exception) -> str:
    text = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
    number = getattr(error, "errno", None)
    if number == 2:
        return "there is no such device"
    if number == 13:
        return "no permission; is this user in the group of the device (often dialout)?"
    if number == 11 or "exclusively lock" in text:
        return "in use by another process"
    if "protocol" in text and "not known" in text:
        return "no such kind of URL; use a device, pty://, listen://, socket:// or another of pyserial's"
    return text.removeprefix(f"{url}: ")[:200]
