"""WitMotion WT931: its byte packets, its commands, and what makes a measurement of packets.

Packets are 11 bytes: 0x55, a type, eight data bytes, the low byte of the sum of the ten before. Nothing marks a start for
certain, and the sum lets one false packet in about 2e4 accepted ones through where bytes are lost, so a packet is believed
only when it continues what is known (`sample_step`). Source: WitMotion's C SDK and protocol sheets.

`sample_step` is plain Python without numba and compiles as it is (`wt931_kernels`).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from softloop.devices.protocols.quantise import ANGLE_FULL_DEG, INT16_FULL, RATE_FULL_DEG_S
from softloop.devices.protocols.wire_time import serial_ns

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

    On a wrong sum or an unknown type it goes on one byte later, never eleven: a lost byte costs its own packet only.

    Attributes:
        taken: bytes fed. accepted: packets returned. skipped: bytes in no packet.
        bad_sum: heads with a known type and a wrong sum. unknown_type: heads with a type that is not enabled.
    """

    def __init__(self, enabled: frozenset[int] = TYPES) -> None:
        self._enabled = enabled
        self._rest = b""
        self.taken = self.accepted = self.skipped = self.bad_sum = self.unknown_type = 0

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

    def forget(self) -> None:
        """Begin anew with the next byte: the stream was interrupted."""
        self.skipped += len(self._rest)
        self._rest = b""

    def _look(self, buffer: bytes, at: int, packets: list[Packet]) -> int:
        """Judge the eleven bytes at `at`; how far to go on."""
        if buffer[at + 1] not in self._enabled:
            self.unknown_type += 1
        elif sum(buffer[at : at + PACKET_BYTES - 1]) & 0xFF != buffer[at + PACKET_BYTES - 1]:
            self.bad_sum += 1
        else:
            _, kind, *words = _PACKET.unpack_from(buffer, at)
            packets.append(Packet(kind, tuple(words), self.taken - len(buffer) + at + PACKET_BYTES))
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
        at = 0
        while (head := buffer.find(b"\xff\xaa", at)) >= 0 and len(buffer) - head >= COMMAND_BYTES:
            found.append((buffer[head + 2], buffer[head + 3] | buffer[head + 4] << 8))
            at = head + COMMAND_BYTES
        if head < 0:
            head = len(buffer) - buffer.endswith(b"\xff", at)  # the second byte of a head may be still to come
        self._rest = buffer[head:]
        return found


def settings(rate_hz: int, bandwidth_hz: int) -> dict[int, int]:
    """Register -> value for gyro and angle packets at this rate, six axes: no magnetometer beside solenoids.

    Raises KeyError on a rate or bandwidth that the device does not have.
    """
    return {RSW: RSW_GYRO_ANGLE, RRATE: RATE_CODES[rate_hz], BANDWIDTH: BANDWIDTH_CODES[bandwidth_hz], AXIS6: 1}


# --- from packets to samples ----------------------------------------------------------------------------------------------

CONFIRMATIONS = 3
"""So many packets in a row that agree with each other are believed against what was known before. Hence, whatever happened,
the third good packet after it is a sample again, and nothing locks the gate for good."""
NOTHING, SAMPLE, SAMPLE_WITHOUT_RATE = 0, 1, 2


@dataclass
class SamplerConfig:
    """Bounds of `sample_step`. Lists: 0 gyro, 1 angle."""

    period_ns: int  # of the device; a shorter time between two stamps is taken as this
    slope_counts_s: list[float]  # how fast the value can change
    noise_counts: list[float]


@dataclass
class SamplerState:
    """What `sample_step` knows. Lists: the gyro packet last believed, the newest one refused, then the same of the angle."""

    count: list[int] = field(default_factory=lambda: [0] * 4)  # 1 once known; refused in a row that agree with each other
    value: list[int] = field(default_factory=lambda: [0] * 4)
    tag: list[int] = field(default_factory=lambda: [0] * 4)  # the version word of angle packets: constant in one device
    stamp_ns: list[int] = field(default_factory=lambda: [0] * 4)
    started: int = 0
    turned: int = 0  # unwrapped angle, counts
    rate: int = 0  # last rate believed, counts
    rejected: int = 0  # packets refused as implausible


def _record(fields: list[Any]) -> np.dtype[Any]:
    return np.dtype((np.record, np.dtype(fields, align=True)))


_I8, _F8 = np.int64, np.float64
SAMPLER_CONFIG = _record([("period_ns", _I8), ("slope_counts_s", _F8, (2,)), ("noise_counts", _F8, (2,))])
SAMPLER_STATE = _record(
    [(name, _I8, (4,)) for name in ("count", "value", "tag", "stamp_ns")]
    + [(name, _I8) for name in ("started", "turned", "rate", "rejected")]
)


def as_record(source: SamplerConfig | SamplerState, dtype: np.dtype[Any]) -> Any:
    """The same as a record (SAMPLER_CONFIG, SAMPLER_STATE), for the compiled `sample_step`."""
    record = np.zeros(1, dtype)[0]
    for name in dtype.names or ():
        record[name] = getattr(source, name)
    return record


def sampler_config(
    rate_hz: float, max_rate_deg_s: float, noise_deg: float, max_acceleration_deg_s2: float, noise_deg_s: float
) -> SamplerConfig:
    """Bounds on rate and acceleration, and what noise may add to one step of angle and rate."""
    return SamplerConfig(
        round(1e9 / rate_hz),
        [max_acceleration_deg_s2 * INT16_FULL / RATE_FULL_DEG_S, max_rate_deg_s * INT16_FULL / ANGLE_FULL_DEG],
        [noise_deg_s * INT16_FULL / RATE_FULL_DEG_S, noise_deg * INT16_FULL / ANGLE_FULL_DEG],
    )


def sample_step(config: Any, state: Any, has_gyro: int, gyro: int, angle: int, version: int, stamp_ns: int) -> int:
    """One angle packet and the gyro packet before it, if there was one -> NOTHING, SAMPLE or SAMPLE_WITHOUT_RATE.

    `gyro` and `angle` are int16 counts; `state` then holds the unwrapped angle in `turned`, and `rate`. A value is believed
    when its tag is the known one and it differs from the last one believed by at most slope times time and noise; or when it
    is the third of CONFIRMATIONS that agree so with each other. Takes the two records or the two dataclasses.
    """
    before = state.value[2]
    believed = 0
    for i in range(1 - has_gyro, 2):
        value, tag = (gyro, 0) if i == 0 else (angle, version)
        known, refused = 2 * i, 2 * i + 1
        near = 0
        for k in range(known, refused + 1):
            change = value - state.value[k]
            if i == 1:
                change = (change + 32768) % 65536 - 32768  # the short way round
            time_s = max(stamp_ns - state.stamp_ns[k], config.period_ns) * 1e-9
            if state.count[k] > 0 and state.tag[k] == tag:
                near += (k - known + 1) * (abs(change) <= config.slope_counts_s[i] * time_s + config.noise_counts[i])
        agreeing = state.count[refused] + 1 if near >= 2 else 1
        keep = known if near % 2 == 1 or agreeing >= CONFIRMATIONS else refused
        state.count[refused] = agreeing if keep == refused else 0
        state.count[keep] = 1 if keep == known else agreeing
        state.value[keep] = value
        state.tag[keep] = tag
        state.stamp_ns[keep] = stamp_ns
        state.rejected += keep == refused
        believed += (1 + i) * (keep == known)
    if believed == 1 or believed == 3:
        state.rate = gyro
    if believed < 2:
        return NOTHING
    turn = (angle - before + 32768) % 65536 - 32768
    state.turned = state.turned + turn if state.started == 1 else angle
    state.started = 1
    return SAMPLE if believed == 3 else SAMPLE_WITHOUT_RATE


class Sample(NamedTuple):
    """One measurement, in counts; `stamp_ns` is when the device began to send it."""

    kind: int
    angle_counts: int
    rate_counts: int
    stamp_ns: int
    received_ns: int


class Sampler:
    """Bytes to samples: `Parser`, pairing, `sample_step`.

    A gyro packet belongs to the angle packet that follows it in the stream with no byte between. A packet or a pair whose
    parts came in different bursts is refused: a lost sum byte can be replaced by the next packet's head (0x55), and a loss of
    exactly 22 bytes joins a gyro packet to the next sample's angle.
    """

    def __init__(self, config: SamplerConfig, baud: int) -> None:
        self.parser = Parser()
        self.registers: list[tuple[int, int, int, int]] = []  # what register reads brought, oldest first
        self._config = config
        self._baud = baud
        self._pause_ns = max(0, config.period_ns - serial_ns(SAMPLE_BYTES, baud)) // 2  # half the line's rest between bursts
        self._state = SamplerState()
        self._gyro: Packet | None = None
        self._gyro_end_ns = 0
        self._torn = 0
        self._arrival_ns = 0

    @property
    def rejected(self) -> int:
        """Packets thrown away in total: wrong sum, torn between two bursts, implausible."""
        return self.parser.bad_sum + self._torn + self._state.rejected

    def feed(self, data: bytes, arrival_ns: int) -> list[Sample]:
        """The samples complete with `data`, whose last byte came at `arrival_ns`; earlier bytes came by the baud rate before."""
        found: list[Sample] = []
        before, before_ns = self.parser.taken, self._arrival_ns
        self._arrival_ns = arrival_ns
        for packet in self.parser.feed(data):
            end_ns = arrival_ns - serial_ns(self.parser.taken - packet.end, self._baud)
            began_before = packet.end - PACKET_BYTES < before
            if began_before and end_ns - before_ns > serial_ns(packet.end - before, self._baud) + self._pause_ns:
                self._torn += 1
            elif packet.kind == GYRO:
                self._gyro, self._gyro_end_ns = packet, end_ns
            elif packet.kind == ANGLE:
                sample = self._measure(packet, end_ns, arrival_ns)
                found.extend([sample] if sample else [])
            else:
                self.registers.append(packet.words)
        return found

    def _measure(self, packet: Packet, end_ns: int, arrival_ns: int) -> Sample | None:
        gyro, self._gyro = self._gyro, None
        near = end_ns - self._gyro_end_ns <= serial_ns(PACKET_BYTES, self._baud) + self._pause_ns
        paired = gyro is not None and gyro.end + PACKET_BYTES == packet.end and near
        rate = gyro.words[0] if gyro is not None and paired else 0
        stamp_ns = end_ns - serial_ns(SAMPLE_BYTES, self._baud)
        kind = sample_step(self._config, self._state, int(paired), rate, packet.words[0], packet.words[3], stamp_ns)
        if kind == NOTHING:
            return None
        return Sample(kind, self._state.turned, self._state.rate, stamp_ns, arrival_ns)
