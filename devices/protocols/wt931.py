"""WitMotion WT931: its byte packets, its commands, and what makes a measurement of packets.

Packets are 11 bytes: 0x55, a type, eight data bytes, the low byte of the sum of the ten before. Nothing marks a start for
certain, and the sum lets one false packet in about 2e4 accepted ones through where bytes are lost, so a packet is believed
only when it continues what is known (`plausible_step`). Source: WitMotion's C SDK and protocol sheets.

The functions over records are plain Python without numba and compile as they are (`wt931_kernels`).
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np

HEAD = 0x55
PACKET_BYTES = 11
GYRO, ANGLE, REGISTERS = 0x52, 0x53, 0x5F
SAMPLE_BYTES = 2 * PACKET_BYTES  # gyro, then angle, back to back
TYPES = frozenset((GYRO, ANGLE, REGISTERS))
_PACKET = struct.Struct("<BB4h")


class Packet(NamedTuple):
    """A packet whose sum is right. `end` counts the bytes of the stream up to and with its last one."""

    kind: int
    words: tuple[int, int, int, int]
    end: int


def encode_packet(kind: int, words: tuple[int, int, int, int]) -> bytes:
    """The 11 bytes of a packet with four int16 words. Raises struct.error when one does not fit."""
    body = _PACKET.pack(HEAD, kind, *words)
    return body + bytes((sum(body) & 0xFF,))


class Parser:
    """Finds packets in a stream of bytes; counts all it throws away.

    On a wrong sum or an unknown type it goes on one byte later, never eleven: a lost byte costs the packet it was in, not the next.

    Attributes:
        taken: bytes fed. accepted: packets returned. skipped: bytes in no packet.
        bad_sum: heads with a known type and a wrong sum. unknown_type: heads with a type that is not enabled.
    """

    def __init__(self, enabled: frozenset[int] = TYPES) -> None:
        self._enabled = enabled
        self._rest = b""
        self.taken = self.accepted = self.skipped = self.bad_sum = self.unknown_type = 0

    @property
    def wanted(self) -> int:
        """How many more bytes the next packet needs at least: what a reader should ask its port for."""
        return PACKET_BYTES - len(self._rest)

    def feed(self, data: bytes) -> list[Packet]:
        """The packets that are complete with `data`."""
        self.taken += len(data)
        buffer = self._rest + data
        packets: list[Packet] = []
        at = 0
        while True:
            found = buffer.find(HEAD, at)
            start = len(buffer) if found < 0 else found
            self.skipped += start - at
            at = start
            if len(buffer) - at < PACKET_BYTES:
                break
            at += self._look(buffer, at, packets)
        self._rest = buffer[at:]
        return packets

    def _look(self, buffer: bytes, at: int, packets: list[Packet]) -> int:
        """Judge the eleven bytes at `at`; how far to go on."""
        if buffer[at + 1] not in self._enabled:
            self.unknown_type += 1
        elif sum(buffer[at : at + PACKET_BYTES - 1]) & 0xFF != buffer[at + PACKET_BYTES - 1]:
            self.bad_sum += 1
        else:
            _, kind, *words = _PACKET.unpack_from(buffer, at)
            packets.append(Packet(kind, tuple(words), self.taken - len(buffer) + at + PACKET_BYTES))  # type: ignore[arg-type]
            self.accepted += 1
            return PACKET_BYTES
        self.skipped += 1
        return 1


# --- commands -------------------------------------------------------------------------------------------------------------

SAVE, RSW, RRATE, BAUD, BANDWIDTH, AXIS6, READ, KEY = 0x00, 0x02, 0x03, 0x04, 0x1F, 0x24, 0x27, 0x69
UNLOCK_VALUE = 0xB588  # FF AA 69 88 B5; the device takes writes for 10 s after it
RSW_GYRO_ANGLE = 0x04 | 0x08
COMMAND_BYTES = 5
RATE_CODES = {10: 0x06, 20: 0x07, 50: 0x08, 100: 0x09, 200: 0x0B}
BAUD_CODES = {4800: 1, 9600: 2, 19200: 3, 38400: 4, 57600: 5, 115200: 6, 230400: 7, 460800: 8, 921600: 9}
BANDWIDTH_CODES = {256: 0, 184: 1, 94: 2, 44: 3, 21: 4, 10: 5, 5: 6}


def encode_command(register: int, value: int) -> bytes:
    """`FF AA register low high`: write a register, or with READ ask for the four registers from `value` on."""
    return bytes((0xFF, 0xAA, register, value & 0xFF, value >> 8 & 0xFF))


def encode_unlock() -> bytes:
    """What must come before each run of writes."""
    return encode_command(KEY, UNLOCK_VALUE)


class CommandParser:
    """The device's side: finds commands in a stream of bytes."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[tuple[int, int]]:
        """(register, value) of each command that is complete with `data`."""
        buffer = self._rest + data
        found: list[tuple[int, int]] = []
        at = buffer.find(b"\xff\xaa")
        while at >= 0 and len(buffer) - at >= COMMAND_BYTES:
            found.append((buffer[at + 2], buffer[at + 3] | buffer[at + 4] << 8))
            at = buffer.find(b"\xff\xaa", at + COMMAND_BYTES)
        if at < 0:
            at = len(buffer) - 1 if buffer.endswith(b"\xff") and not found else len(buffer)
        self._rest = buffer[at:]
        return found


def settings(rate_hz: int, baud: int, bandwidth_hz: int) -> list[tuple[int, int]]:
    """(register, value) of gyro and angle packets at this rate, six axes: no magnetometer beside solenoids.

    Raises KeyError on a rate, baud or bandwidth that the device does not have.
    """
    return [
        (RSW, RSW_GYRO_ANGLE),
        (RRATE, RATE_CODES[rate_hz]),
        (BANDWIDTH, BANDWIDTH_CODES[bandwidth_hz]),
        (AXIS6, 1),
        (BAUD, BAUD_CODES[baud]),
    ]


# --- from packets to samples ----------------------------------------------------------------------------------------------

CONFIRMATIONS = 3
"""So many packets in a row that agree with each other are believed against what was known before. Hence, whatever happened,
the third good packet after it is a sample again, and nothing locks the gate for good."""


def _record(fields: list[Any]) -> np.dtype[Any]:
    return np.dtype((np.record, np.dtype(fields, align=True)))


PLAUSIBLE = _record([
    ("known", np.int64),        # 1 when value, tag and stamp_ns hold an accepted packet
    ("value", np.int64),
    ("tag", np.int64),
    ("stamp_ns", np.int64),
    ("candidates", np.int64),   # refused packets in a row that agree with each other; the newest of them:
    ("candidate", np.int64),
    ("candidate_tag", np.int64),
    ("candidate_stamp_ns", np.int64),
])  # fmt: skip
"""What is known of one stream of int16 values."""

SAMPLER_CONFIG = _record([
    ("period_ns", np.int64),                # of the device; a shorter time between stamps is taken as this
    ("angle_counts_s", np.float64),         # how fast the angle can change
    ("angle_noise_counts", np.float64),
    ("gyro_counts_s", np.float64),          # how fast the rate can change
    ("gyro_noise_counts", np.float64),
])  # fmt: skip

SAMPLER_STATE = _record([
    ("angle", PLAUSIBLE),
    ("gyro", PLAUSIBLE),
    ("turned", np.int64),                   # unwrapped angle, counts
    ("started", np.int64),
    ("rate", np.int64),                     # last rate believed, counts
    ("rejected", np.int64),                 # packets refused as implausible
])  # fmt: skip


def new_state(dtype: np.dtype[Any]) -> Any:
    """One zeroed record, writable in place."""
    return np.zeros(1, dtype)[0]


def sampler_config(rate_hz: float, max_rate_deg_s: float, noise_deg: float, max_acceleration_deg_s2: float, noise_deg_s: float) -> Any:
    """A SAMPLER_CONFIG record from bounds in degrees."""
    config = new_state(SAMPLER_CONFIG)
    config.period_ns = round(1e9 / rate_hz)
    config.angle_counts_s = max_rate_deg_s * 32768.0 / 180.0
    config.angle_noise_counts = noise_deg * 32768.0 / 180.0
    config.gyro_counts_s = max_acceleration_deg_s2 * 32768.0 / 2000.0
    config.gyro_noise_counts = noise_deg_s * 32768.0 / 2000.0
    return config


def wrapped(counts: int) -> int:
    """A difference of angles brought into -32768..32767: the short way round."""
    return (counts + 32768) % 65536 - 32768


def make_plausible_step(wrap: Any) -> Any:
    """Bind `plausible_step` to the callee it uses: plain here, compiled in `wt931_kernels`."""

    def plausible_step(
        state: Any, value: int, tag: int, stamp_ns: int, turning: int, slope_s: float, noise: float, period_ns: int
    ) -> int:
        """1 when a value is to be believed. `state` is PLAUSIBLE, `turning` is 1 for angles, `slope_s` counts per second.

        A value is believed when it differs from the last believed one by no more than slope times time and noise, and its
        tag (the version word of angle packets) is the same; else it becomes, or confirms, a candidate.
        """
        if state.known == 1 and tag == state.tag:
            change = value - state.value
            if turning == 1:
                change = wrap(change)
            if abs(change) <= slope_s * 1e-9 * max(stamp_ns - state.stamp_ns, period_ns) + noise:
                state.value = value
                state.stamp_ns = stamp_ns
                state.candidates = 0
                return 1
        agrees = 0
        if state.candidates > 0 and tag == state.candidate_tag:
            change = value - state.candidate
            if turning == 1:
                change = wrap(change)
            if abs(change) <= slope_s * 1e-9 * max(stamp_ns - state.candidate_stamp_ns, period_ns) + noise:
                agrees = 1
        state.candidates = state.candidates + 1 if agrees == 1 else 1
        state.candidate = value
        state.candidate_tag = tag
        state.candidate_stamp_ns = stamp_ns
        if state.candidates < 3:
            return 0
        state.known = 1
        state.value = value
        state.tag = tag
        state.stamp_ns = stamp_ns
        state.candidates = 0
        return 1

    return plausible_step


def make_sample_step(wrap: Any, plausible: Any) -> Any:
    """Bind `sample_step` to the callees it uses."""
