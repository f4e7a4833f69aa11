"""What stands behind the gate on CAN: the rig's own valve driver, or a CANopen node. Chosen by `[valves] driver`.

The gate gives each step's currents to `frames`, sends what comes back, and hands each frame of the bus to `hear`. Nothing
here judges: an adapter turns counts of 0.01 mA into a device's bytes, and a device's bytes into ValveStatus DRIVER_*.
"""

from __future__ import annotations

from typing import Protocol

from softloop.devices.config import PERIOD_NS, ValvesProcess
from softloop.devices.protocols import can_frames
from softloop.devices.protocols import canopen_output as co
from softloop.devices.protocols.quantise import counts_to_current, current_to_counts
from softloop.wire.can_frame import CanFrame
from softloop.wire.can_port import CanPort
from softloop.wire.clock import Clock
from softloop.wire.errors import Unavailable
from softloop.wire.messages import constant

DRIVER_OK, DRIVER_WATCHDOG = constant("ValveStatus", "DRIVER_OK"), constant("ValveStatus", "DRIVER_WATCHDOG")
NOT_MEASURED = -1
Frames = list[tuple[int, bytes]]
_START_AGAIN_FRAMES = 200  # a node that is not operational is asked to be once a second


class ValveDriver(Protocol):
    """A device that drives the two coils.

    Attributes:
        receive: arbitration ids that it may send to the gate.
        rejected: frames of it thrown away, in total.
        coils: counts of 0.01 mA that it measured last, charge and exhaust; NOT_MEASURED where it says none.
    """

    receive: tuple[int, ...]
    coils: tuple[int, int]

    @property
    def rejected(self) -> int: ...

    def prepare(self, port: CanPort, clock: Clock) -> None:
        """Before the first step: see that the device is as it must be. Raises Unavailable, Lost."""

    def realised(self, counts: int) -> int:
        """What becomes of a current on the way to the device, counts of 0.01 mA."""

    def frames(self, output: int, charge_counts: int, exhaust_counts: int, seq: int) -> Frames:
        """(id, data) of one step's frames, the set points first."""

    def hear(self, frame: CanFrame) -> int | None:
        """DRIVER_* that a frame says, None for nothing."""


def make_driver(config: ValvesProcess) -> ValveDriver:
    """The driver that the bench file names."""
    node = config.valves.node
    return RigDriver(config.valves.driver_max_lost) if node is None else CanopenDriver(node.plan(config.valves.vent_current_ma))


class RigDriver:
    """The rig's own driver: frames of `rig.dbc`, with counter and CRC both ways."""

    receive: tuple[int, ...] = (can_frames.VALVE_STATUS_ID,)

    def __init__(self, max_lost: int) -> None:
        self._judge = can_frames.E2eReceiver(can_frames.VALVE_STATUS_ID, max_lost)
        self.coils = (0, 0)
        # Load what encodes and decodes before the loop.
        can_frames.decode_valve_status(bytes(can_frames.DLC))
        self.frames(0, 0, 0, 0)

    @property
    def rejected(self) -> int:
        return self._judge.rejected

    def prepare(self, port: CanPort, clock: Clock) -> None:
        """Nothing: what it does without the gate is built into it."""

    def realised(self, counts: int) -> int:
        return counts

    def frames(self, output: int, charge_counts: int, exhaust_counts: int, seq: int) -> Frames:
        counter = seq % can_frames.COUNTER_STATES
        frame = can_frames.ValveCommandFrame(counter, output, charge_counts, exhaust_counts, seq & 0xFFFF)
        return [(can_frames.VALVE_COMMAND_ID, can_frames.encode_valve_command(frame))]

    def hear(self, frame: CanFrame) -> int | None:
        data = frame.data[: frame.dlc]
        if frame.arbitration_id != can_frames.VALVE_STATUS_ID or not self._judge.judge(data).usable:
            return None
        status = can_frames.decode_valve_status(data)
        self.coils = (status.charge_counts, status.exhaust_counts)
        return DRIVER_OK if status.state == can_frames.STATE_OK else DRIVER_WATCHDOG


class CanopenDriver:
    """A CANopen node with analogue or current outputs.

    It is alive by its heartbeat; in any state but operational, and on an emergency message, it is taken for one that vents
    by itself. A node that restarts may have forgotten its settings: it is not commanded again.
    """

    def __init__(self, plan: co.NodePlan) -> None:
        self.plan = plan
        self.receive: tuple[int, ...] = (plan.heartbeat_id, plan.emergency_id, plan.measured_id, plan.sdo_answer_id)
        self.rejected = 0
        self.coils = (NOT_MEASURED, NOT_MEASURED)
        self.restarted = False
        self._state = co.PRE_OPERATIONAL
        self._asked_at = -_START_AGAIN_FRAMES
        self._heartbeat_frames = max(1, round(plan.gate_heartbeat_ms * 1e6 / PERIOD_NS) // 4)

    def prepare(self, port: CanPort, clock: Clock) -> None:
        """Read the node's settings. Raises Unavailable when one of them is not what makes it vent by itself; Lost."""
        from softloop.devices.canopen_node import talking  # noqa: PLC0415 - the library is for those who have such a node

        with talking(port, self.plan.node_id, clock) as talk:
            wrong = talk.wrong(co.required_settings(self.plan))
            if wrong:
                more = f" (and {len(wrong) - 1} more)" if len(wrong) > 1 else ""
                raise Unavailable(f"{talk.where}: {wrong[0]}{more}; run `softloop canopen configure BENCH.toml`")

    def realised(self, counts: int) -> int:
        return current_to_counts(self.plan.scale.current_ma(self.plan.scale.counts(counts_to_current(counts))))

    def frames(self, output: int, charge_counts: int, exhaust_counts: int, seq: int) -> Frames:
        plan, scale = self.plan, self.plan.scale
        data = co.encode_setpoints(
            scale.counts(counts_to_current(charge_counts)), scale.counts(counts_to_current(exhaust_counts))
        )
        made = [(plan.setpoint_id, data)]
        if seq % self._heartbeat_frames == 0:
            made.append((plan.gate_heartbeat_id, bytes((co.OPERATIONAL,))))
        if self._state != co.OPERATIONAL and not self.restarted and seq - self._asked_at >= _START_AGAIN_FRAMES:
            self._asked_at = seq
            made.append((co.NMT_ID, bytes((co.NMT_START, plan.node_id))))
        return [] if self.restarted else made

    def hear(self, frame: CanFrame) -> int | None:
        data, sender = frame.data[: frame.dlc], frame.arbitration_id
        if sender == self.plan.heartbeat_id and len(data) == 1:
            self._state = data[0] & 0x7F  # the highest bit is node guarding's
            self.restarted |= self._state == co.BOOT_UP
            return DRIVER_OK if self._state == co.OPERATIONAL and not self.restarted else DRIVER_WATCHDOG
        if sender == self.plan.emergency_id and len(data) == 8:
            return DRIVER_WATCHDOG if data[:2] != b"\0\0" else None  # error code 0: all is well again
        if sender == self.plan.measured_id and self.plan.measured_index and len(data) == 4:
            self.coils = self._measured(data)
        elif sender != self.plan.sdo_answer_id:
            self.rejected += 1
        return None

    def _measured(self, data: bytes) -> tuple[int, int]:
        charge, exhaust = (current_to_counts(self.plan.scale.current_ma(counts)) for counts in co.decode_setpoints(data))
        return charge, exhaust
