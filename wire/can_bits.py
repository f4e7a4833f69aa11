"""Classic CAN frames as bits (ISO 11898-1): the exact length on the wire, stuffed as this identifier and this data make it."""

from __future__ import annotations

from softloop.wire.can_frame import FLAG_EXTENDED, FLAG_REMOTE, CanFrame

CRC_POLYNOMIAL = 0x4599
CRC_BITS = 15
TAIL_BITS = 13  # CRC delimiter, acknowledge slot and its delimiter, end of frame (7) and interframe space (3), never stuffed
ERROR_FRAME_BITS = 17  # error flag (6), error delimiter (8), interframe space (3)


def header_and_data(frame: CanFrame) -> list[int]:
    """Bits from the start of frame to the last data bit, without stuffing; 0 is dominant."""
    remote = 1 if frame.flags & FLAG_REMOTE else 0
    bits = [0]
    if frame.flags & FLAG_EXTENDED:
        bits += [*_number(frame.arbitration_id >> 18, 11), 1, 1, *_number(frame.arbitration_id & 262143, 18), remote, 0, 0]
    else:
        bits += [*_number(frame.arbitration_id, 11), remote, 0, 0]
    bits += _number(frame.dlc, 4)
    if not remote:
        for byte in frame.data[: frame.dlc]:
            bits += _number(byte, 8)
    return bits


def _number(value: int, width: int) -> list[int]:
    return [(value >> k) & 1 for k in range(width - 1, -1, -1)]


def crc15(bits: list[int]) -> int:
    """The frame's checksum over its bits from the start of frame on."""
    register = 0
    for bit in bits:
        feed = bit ^ (register >> (CRC_BITS - 1))
        register = (register << 1) & 0x7FFF
        if feed:
            register ^= CRC_POLYNOMIAL
    return register


def stuff_bits(bits: list[int]) -> int:
    """How many bits are put in: one of the other kind after five alike, which then counts itself."""
    stuffed, run, last = 0, 0, -1
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            stuffed += 1
            last, run = 1 - bit, 1
    return stuffed


def frame_bits(frame: CanFrame) -> int:
    """Bits on the wire from start of frame to the end of the interframe space."""
    bits = header_and_data(frame)
    bits += _number(crc15(bits), CRC_BITS)
    return len(bits) + stuff_bits(bits) + TAIL_BITS


def arbitration_rank(frame: CanFrame) -> tuple[int, int, int]:
    """What decides arbitration: the smaller wins. A standard frame wins over an extended one with the same 11 first bits."""
    extended = 1 if frame.flags & FLAG_EXTENDED else 0
    remote = 1 if frame.flags & FLAG_REMOTE else 0
    if extended:
        # After the 11 first bits the recessive SRR and IDE lose to the RTR of a standard frame, remote or not.
        return frame.arbitration_id >> 18, 2, ((frame.arbitration_id & 0x3FFFF) << 1) | remote
    return frame.arbitration_id, remote, 0
