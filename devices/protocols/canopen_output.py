"""A CANopen node with analogue or current outputs as valve driver: set points, scale, and the settings that make it safe.

The node must vent by itself when the gate is not heard. CiA 301 and CiA 401 give the means: a deadline on the receive PDO
(its event timer) and on the gate's heartbeat (1016h) lead to the state of 1029h, in which an output takes its error value
(6444h) where its error mode (6443h) is 1: charge without current, exhaust at the vent current.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace

NMT_ID = 0x000
EMERGENCY_BASE, HEARTBEAT_BASE = 0x080, 0x700
SDO_ANSWER_BASE = 0x580
_RPDO_BASE, _TPDO_ID_BASE = 0x200, 0x180  # of the first of each; a further RPDO is 0x100 more
NMT_START = 0x01
NMT_PRE_OPERATIONAL_COMMAND = 0x80
BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
STATE_NAMES = {BOOT_UP: "starting", STOPPED: "stopped", OPERATIONAL: "operational", PRE_OPERATIONAL: "pre-operational"}
PDO_OFF = 0x8000_0000
EVENT_DRIVEN = 255  # a PDO's transmission type: a set point takes effect when it arrives
TO_ERROR_VALUE = 1  # an error mode of 6443h
ERROR_STATES = {"pre-operational": 0, "stopped": 2}  # of 1029h
STORE, STORE_SIGNATURE = (0x1010, 1), 0x65766173  # "save"
_SETPOINTS = struct.Struct("<hh")


@dataclass(frozen=True)
class Scale:
    """Between current and counts of one node; see `CanopenConfig`."""

    off_counts: int
    low_counts: int
    low_ma: float
    full_counts: int
    full_ma: float

    def counts(self, current_ma: float) -> int:
        """The set point of a current, rounded down: never more than was asked for, never above full scale."""
        if not current_ma > 0.0 or current_ma < self.low_ma:
            return self.off_counts
        part = min(1.0, (current_ma - self.low_ma) / (self.full_ma - self.low_ma))
        exact = part * (self.full_counts - self.low_counts)
        return self.low_counts + int(exact + 1e-6)  # what is a whole count but for its last bits is that count

    def current_ma(self, counts: int) -> float:
        """The current of a set point, or of a measured value on the same scale."""
        if counts == self.off_counts or counts < self.low_counts:
            return 0.0
        return self.low_ma + (counts - self.low_counts) / (self.full_counts - self.low_counts) * (self.full_ma - self.low_ma)


@dataclass(frozen=True)
class Setting:
    """One object that must hold a value. `size` in bytes; a negative value is two's complement."""

    index: int
    sub: int
    size: int
    value: int
    what: str

    @property
    def data(self) -> bytes:
        return (self.value & (1 << 8 * self.size) - 1).to_bytes(self.size, "little")

    @property
    def name(self) -> str:
        return f"{self.index:04X}h:{self.sub:02X} ({self.what})"

    @property
    def is_identifier(self) -> bool:
        """Whether it is a PDO's identifier."""
        return self.sub == 1 and self.index & 0xFE00 in (0x1400, 0x1800)

    @property
    def is_length(self) -> bool:
        """Whether it is the number of entries of a PDO's mapping."""
        return self.sub == 0 and self.index & 0xFE00 in (0x1600, 0x1A00)


@dataclass(frozen=True)
class NodePlan:
    """A node as valve driver: its numbers, its scale, and what its error values are to be.

    Attributes:
        outputs: sub-indices of charge and exhaust.
        measured_index: object of the measured currents; 0 for none.
        vent_ma: exhaust current while venting.
    """

    node_id: int
    gate_node_id: int
    outputs: tuple[int, int]
    rpdo: int
    deadline_ms: int
    gate_heartbeat_ms: int
    heartbeat_ms: int
    error_state: str
    error_value_shift: int
    setpoint_index: int
    error_mode_index: int
    error_value_index: int
    measured_index: int
    scale: Scale
    vent_ma: float

    @property
    def setpoint_id(self) -> int:
        return _RPDO_BASE + 0x100 * (self.rpdo - 1) + self.node_id

    @property
    def heartbeat_id(self) -> int:
        return HEARTBEAT_BASE + self.node_id

    @property
    def gate_heartbeat_id(self) -> int:
        return HEARTBEAT_BASE + self.gate_node_id

    @property
    def emergency_id(self) -> int:
        return EMERGENCY_BASE + self.node_id

    @property
    def measured_id(self) -> int:
        return _TPDO_ID_BASE + self.node_id

    @property
    def sdo_answer_id(self) -> int:
        return SDO_ANSWER_BASE + self.node_id

    @property
    def error_counts(self) -> tuple[int, int]:
        """Set points of charge and exhaust in a vent."""
        return self.scale.off_counts, self.scale.counts(self.vent_ma)


def encode_setpoints(charge_counts: int, exhaust_counts: int) -> bytes:
    """The receive PDO's four bytes. Raises struct.error when a count is no int16."""
    return _SETPOINTS.pack(charge_counts, exhaust_counts)


def decode_setpoints(data: bytes) -> tuple[int, int]:
    """Charge and exhaust counts of four bytes. Raises struct.error on another length."""
    charge, exhaust = _SETPOINTS.unpack(data)
    return charge, exhaust


def required_settings(plan: NodePlan) -> list[Setting]:
    """What the node must hold for the gate to use it, in the order in which it is read back."""
    parameters = 0x1400 + plan.rpdo - 1
    charge, exhaust = plan.outputs
    settings = [
        Setting(0x1016, 1, 4, plan.gate_node_id << 16 | plan.gate_heartbeat_ms, "heartbeat consumer: the gate"),
        Setting(0x1017, 0, 2, plan.heartbeat_ms, "heartbeat producer"),
        Setting(0x1029, 1, 1, ERROR_STATES[plan.error_state], "state after a communication error"),
        Setting(parameters, 2, 1, EVENT_DRIVEN, "receive PDO: transmission type"),
        Setting(parameters, 5, 2, plan.deadline_ms, "receive PDO: deadline"),
        *_mapping(0x1600 + plan.rpdo - 1, plan.setpoint_index, plan.outputs, "receive PDO"),
        Setting(parameters, 1, 4, plan.setpoint_id, "receive PDO: identifier"),
    ]
    for name, sub, counts in (("charge", charge, plan.error_counts[0]), ("exhaust", exhaust, plan.error_counts[1])):
        settings.append(Setting(plan.error_mode_index, sub, 1, TO_ERROR_VALUE, f"error mode of {name}"))
        settings.append(Setting(plan.error_value_index, sub, 4, counts << plan.error_value_shift, f"error value of {name}"))
    return [*settings, *_measured_settings(plan)]


def _measured_settings(plan: NodePlan) -> list[Setting]:
    if not plan.measured_index:
        return []
    return [
        Setting(0x1800, 2, 1, EVENT_DRIVEN, "transmit PDO: transmission type"),
        Setting(0x1800, 5, 2, plan.heartbeat_ms, "transmit PDO: period"),
        *_mapping(0x1A00, plan.measured_index, plan.outputs, "transmit PDO"),
        Setting(0x1800, 1, 4, plan.measured_id, "transmit PDO: identifier"),
    ]


def _mapping(index: int, mapped: int, outputs: Sequence[int], what: str) -> list[Setting]:
    entries = [Setting(index, i, 4, mapped << 16 | sub << 8 | 16, f"{what}: entry {i}") for i, sub in enumerate(outputs, 1)]
    return [*entries, Setting(index, 0, 1, len(outputs), f"{what}: entries")]


def writing_order(settings: Sequence[Setting]) -> list[Setting]:
    """The same as they are to be written: a PDO is changed while it is off and its mapping while it is empty (CiA 301)."""
    off = [replace(s, value=s.value | PDO_OFF, what=f"{s.what}, off") for s in settings if s.is_identifier]
    empty = [replace(s, value=0, what=f"{s.what}, none") for s in settings if s.is_length]
    return [*off, *empty, *settings]
