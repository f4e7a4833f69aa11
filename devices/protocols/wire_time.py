"""How long a frame or a run of bytes stands on its wire."""

from __future__ import annotations

_STUFFED_BITS = 34  # start bit, 11-bit identifier, RTR, IDE, r0, DLC and CRC: what bit stuffing covers besides the data
_FRAME_BITS = 47  # those 34, and CRC delimiter, acknowledge (2), end of frame (7) and interframe space (3)
_BITS_PER_BYTE = 10  # start, eight data, stop


def can_frame_ns(dlc: int, bitrate: int) -> int:
    """Worst-case time of a classic CAN frame with an 11-bit identifier and `dlc` data bytes (ISO 11898-1 stuffing), ns."""
    if not 0 <= dlc <= 8:
        raise ValueError(f"a classic CAN frame has 0 to 8 data bytes, not {dlc}")
    stuffed = (_STUFFED_BITS + 8 * dlc - 1) // 4
    return (stuffed + 8 * dlc + _FRAME_BITS) * 1_000_000_000 // bitrate


def serial_ns(n_bytes: int, baud: int) -> int:
    """Time of `n_bytes` on an 8N1 serial line, ns."""
    return n_bytes * _BITS_PER_BYTE * 1_000_000_000 // baud
