"""The simulated WT931's register side: it takes the commands that the real one takes, and answers reads.

Writes need the unlock and hold for 10 s after it; what is written takes effect with the save command, as WitMotion's sheets
say. Of the packet types it sends two, gyro and angle; asking for others sends nothing more.
"""

from __future__ import annotations

from math import pi

from softloop.devices.protocols.wire_time import serial_ns
from softloop.devices.protocols.wt931 import (
    ANGLE,
    AXIS6,
    BANDWIDTH,
    BANDWIDTH_CODES,
    BAUD,
    BAUD_CODES,
    GYRO,
    KEY,
    PACKET_BYTES,
    RATE_CODES,
    READ,
    REGISTERS,
    RRATE,
    RSW,
    RSW_GYRO_ANGLE,
    SAVE,
    UNLOCK_VALUE,
    CommandParser,
    encode_packet,
)
from softloop.plant.records import CONTENT_ANGLE, CONTENT_GYRO

UNLOCKED_NS = 10_000_000_000
SAVE_NOW, RESTART = 0x00, 0xFF
RSW_GYRO, RSW_ANGLE = 0x04, 0x08
# The fourth words of the packets: temperature is a constant here, and the version never changes in one device.
TEMPERATURE_WORD = 2500  # 25.00 C
VERSION_WORD = 0x2711
_RATES_HZ = {code: hz for hz, code in RATE_CODES.items()}
_BAUDS = {code: baud for baud, code in BAUD_CODES.items()}
_BANDWIDTHS_HZ = {code: hz for hz, code in BANDWIDTH_CODES.items()}


class InclinometerDevice:
    """Registers as written and as in effect; starts with gyro and angle packets on at the given settings."""

    def __init__(self, rate_hz: int, baud: int, bandwidth_hz: int) -> None:
        self.written = {
            RSW: RSW_GYRO_ANGLE,
            RRATE: RATE_CODES[rate_hz],
            BAUD: BAUD_CODES[baud],
            BANDWIDTH: BANDWIDTH_CODES[bandwidth_hz],
            AXIS6: 1,
        }
        self.active = dict(self.written)
        self._unlocked_until_ns = -1
        self._parser = CommandParser()

    @property
    def baud(self) -> int:
        return _BAUDS.get(self.active[BAUD], 9600)

    @property
    def content(self) -> int:
        """CONTENT_* bits: the packets of one sample."""
        asked = self.active[RSW]
        return (CONTENT_GYRO if asked & RSW_GYRO else 0) | (CONTENT_ANGLE if asked & RSW_ANGLE else 0)

    @property
    def wire_ns(self) -> int:
        """Time of one sample's packets on the serial line."""
        return serial_ns(PACKET_BYTES * self.content.bit_count(), self.baud)

    @property
    def period_ns(self) -> int:
        """By the device's own clock; 0 when it sends nothing. A line too slow for the rate lowers it, as in the device."""
        rate_hz = _RATES_HZ.get(self.active[RRATE], 0)
        return max(1_000_000_000 // rate_hz, self.wire_ns) if rate_hz and self.content else 0

    @property
    def lag_s(self) -> float:
        """The filter as a first-order lag."""
        return 1.0 / (2.0 * pi * _BANDWIDTHS_HZ.get(self.active[BANDWIDTH], 256))

    def feed(self, data: bytes, now_ns: int) -> bytes:
        """Take bytes from the host; returns what the device answers."""
        answer = b""
        for register, value in self._parser.feed(data):
            if register == READ:
                answer += self._read(value & 0xFF)
            else:
                self._write(register, value, now_ns)
        return answer

    def packets(self, content: int, gyro: int, angle: int) -> bytes:
        """The bytes of one sample."""
        sent = encode_packet(GYRO, (gyro, 0, 0, TEMPERATURE_WORD)) if content & CONTENT_GYRO else b""
        return sent + (encode_packet(ANGLE, (angle, 0, 0, VERSION_WORD)) if content & CONTENT_ANGLE else b"")

    def _read(self, first: int) -> bytes:
        words = [self.written.get(first + i, 0) for i in range(4)]
        signed = [w - 65536 if w >= 32768 else w for w in words]
        return encode_packet(REGISTERS, (signed[0], signed[1], signed[2], signed[3]))

    def _write(self, register: int, value: int, now_ns: int) -> None:
        if register == KEY:
            self._unlocked_until_ns = now_ns + UNLOCKED_NS if value == UNLOCK_VALUE else -1
        elif now_ns > self._unlocked_until_ns:
            return
        elif register == SAVE:
            self._save(value)
        else:
            self.written[register] = value

    def _save(self, value: int) -> None:
        if value == SAVE_NOW:
            self.active = dict(self.written)
        elif value == RESTART:
            self.written = dict(self.active)
        self._unlocked_until_ns = -1
