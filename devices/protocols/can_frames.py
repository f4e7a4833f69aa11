"""The rig's CAN frames: `rig.dbc` through cantools, AUTOSAR E2E profile 1, and a receiver's verdicts.

Currents and voltages stay raw counts here; `quantise` gives them their units.
"""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path
from typing import Any, NamedTuple

import cantools

from softloop.wire.errors import BadFile

DBC_FILE = Path(__file__).resolve().parent / "rig.dbc"
_DATABASE: Any = cantools.database.load_file(DBC_FILE)
_COMMAND = _DATABASE.get_message_by_name("VALVE_COMMAND")
_STATUS = _DATABASE.get_message_by_name("VALVE_STATUS")
_ANALOG = _DATABASE.get_message_by_name("ANALOG_INPUTS")

VALVE_COMMAND_ID: int = _COMMAND.frame_id
VALVE_STATUS_ID: int = _STATUS.frame_id
ANALOG_INPUTS_ID: int = _ANALOG.frame_id
DLC = 8
COUNTER_STATES = 15  # profile 1 counts 0..14; 15 is never sent
STATE_OK, STATE_WATCHDOG = 0, 1


class BadFrame(BadFile):
    """CAN data that cannot be the frame its identifier names."""


class ValveCommandFrame(NamedTuple):
    """VALVE_COMMAND: currents in 0.01 mA, `output` as ValveStatus OUTPUT_*, `seq` modulo 65536."""

    counter: int
    output: int
    charge_counts: int
    exhaust_counts: int
    seq: int


class ValveStatusFrame(NamedTuple):
    """VALVE_STATUS: coil currents in 0.01 mA, `state` STATE_*, `seq` of the last good command."""

    counter: int
    state: int
    charge_counts: int
    exhaust_counts: int
    seq: int


class AnalogFrame(NamedTuple):
    """ANALOG_INPUTS: int16 counts of the two pressures, `counter` modulo 256."""

    supply_counts: int
    chamber_counts: int
    counter: int


def _crc_table() -> list[int]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = ((value << 1) ^ 0x1D if value & 0x80 else value << 1) & 0xFF  # SAE J1850, as profile 1 uses it
        table.append(value)
    return table


_CRC_TABLE = _crc_table()


def e2e_crc(data: bytes, data_id: int) -> int:
    """CRC of AUTOSAR E2E profile 1: data id, low byte first, then `data` without its first byte; start and final xor 0."""
    crc = _CRC_TABLE[_CRC_TABLE[data_id & 0xFF] ^ data_id >> 8]
    for byte in data[1:]:
        crc = _CRC_TABLE[crc ^ byte]
    return crc


def _seal(data: bytes, data_id: int) -> bytes:
    return bytes((e2e_crc(data, data_id),)) + data[1:]


def _check_length(data: bytes, name: str) -> None:
    if len(data) != DLC:
        raise BadFrame(f"{name}: has {DLC} data bytes, got {len(data)}")


def encode_valve_command(frame: ValveCommandFrame) -> bytes:
    """The 8 data bytes, with CRC. Raises OverflowError when a number does not fit its field."""
    signals = {
        "CRC": 0, "COUNTER": frame.counter, "OUTPUT": frame.output, "CHARGE_CURRENT": frame.charge_counts,
        "EXHAUST_CURRENT": frame.exhaust_counts, "SEQ": frame.seq,
    }  # fmt: skip
    return _seal(_COMMAND.encode(signals, scaling=False, strict=False), VALVE_COMMAND_ID)


def decode_valve_command(data: bytes) -> ValveCommandFrame:
    """The frame in 8 data bytes, whatever its CRC (`E2eReceiver` judges that). Raises BadFrame on another length."""
    _check_length(data, "VALVE_COMMAND")
    s = _COMMAND.decode(data, decode_choices=False, scaling=False)
    return ValveCommandFrame(s["COUNTER"], s["OUTPUT"], s["CHARGE_CURRENT"], s["EXHAUST_CURRENT"], s["SEQ"])


def encode_valve_status(frame: ValveStatusFrame) -> bytes:
    """The 8 data bytes, with CRC. Raises OverflowError when a number does not fit its field."""
    signals = {
        "CRC": 0, "COUNTER": frame.counter, "STATE": frame.state, "CHARGE_COIL": frame.charge_counts,
        "EXHAUST_COIL": frame.exhaust_counts, "SEQ": frame.seq,
    }  # fmt: skip
    return _seal(_STATUS.encode(signals, scaling=False, strict=False), VALVE_STATUS_ID)


def decode_valve_status(data: bytes) -> ValveStatusFrame:
    """The frame in 8 data bytes, whatever its CRC (`E2eReceiver` judges that). Raises BadFrame on another length."""
    _check_length(data, "VALVE_STATUS")
    s = _STATUS.decode(data, decode_choices=False, scaling=False)
    return ValveStatusFrame(s["COUNTER"], s["STATE"], s["CHARGE_COIL"], s["EXHAUST_COIL"], s["SEQ"])


def encode_analog_inputs(frame: AnalogFrame) -> bytes:
    """The 8 data bytes. Raises OverflowError when a number does not fit its field."""
    signals = {"SUPPLY": frame.supply_counts, "CHAMBER": frame.chamber_counts, "COUNTER": frame.counter}
    return bytes(_ANALOG.encode(signals, scaling=False, strict=False))


def decode_analog_inputs(data: bytes) -> AnalogFrame:
    """The frame in 8 data bytes. Raises BadFrame on another length."""
    _check_length(data, "ANALOG_INPUTS")
    s = _ANALOG.decode(data, decode_choices=False, scaling=False)
    return AnalogFrame(s["SUPPLY"], s["CHAMBER"], s["COUNTER"])


class Verdict(IntEnum):
    """A receiver's word on one protected frame; `OK` and `SOME_LOST` are to be used, the others thrown away."""

    OK = 0
    SOME_LOST = 1  # frames are missing before this one, not more than allowed
    REPEATED = 2
    WRONG_SEQUENCE = 3  # more are missing than allowed, or the counter is 15
    WRONG_CRC = 4
    WRONG_LENGTH = 5

    @property
    def usable(self) -> bool:
        return self <= Verdict.SOME_LOST


class E2eReceiver:
    """Judges the frames of one identifier by length, CRC and counter.

    A frame out of sequence is refused and becomes the new start of counting, so that a sender that was restarted is heard
    from its second frame on. `lost` counts missing frames as far as a counter of 15 states tells, `rejected` refused ones.
    """

    def __init__(self, data_id: int, max_delta: int) -> None:
        self.data_id = data_id
        self.max_delta = max_delta
        self.lost = 0
        self.rejected = 0
        self._last = -1

    def judge(self, data: bytes) -> Verdict:
        """The verdict on one frame's data."""
        verdict = self._judge(data)
        self.rejected += not verdict.usable
        return verdict

    def _judge(self, data: bytes) -> Verdict:
        if len(data) != DLC:
            return Verdict.WRONG_LENGTH
        if data[0] != e2e_crc(data, self.data_id):
            return Verdict.WRONG_CRC
        counter = data[1] & 0x0F
        if counter >= COUNTER_STATES:
            return Verdict.WRONG_SEQUENCE
        delta = (counter - self._last) % COUNTER_STATES if self._last >= 0 else 1
        self._last = counter
        if delta == 0:
            return Verdict.REPEATED
        self.lost += delta - 1
        if delta == 1:
            return Verdict.OK
        return Verdict.SOME_LOST if delta <= self.max_delta else Verdict.WRONG_SEQUENCE


def next_counter(counter: int) -> int:
    """The profile 1 counter after `counter`."""
    return (counter + 1) % COUNTER_STATES
