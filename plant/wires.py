"""The ends of the plant's wires: CAN buses and the serial port, and what is under way on them."""

from __future__ import annotations

import contextlib
import heapq
from itertools import count
from typing import Any

import serial

from softloop.devices.protocols.can_frames import (
    ANALOG_INPUTS_ID,
    DLC,
    VALVE_COMMAND_ID,
    VALVE_STATUS_ID,
    AnalogFrame,
    E2eReceiver,
    ValveStatusFrame,
    decode_valve_command,
    encode_analog_inputs,
    encode_valve_status,
    next_counter,
)
from softloop.devices.protocols.wire_time import can_frame_ns, serial_ns
from softloop.plant.config import PlantConfig, PlantProcess
from softloop.plant.electrical import accept_command
from softloop.plant.inclinometer_device import InclinometerDevice
from softloop.plant.records import EVENT_ANALOG_FRAME, EVENT_DRIVER_FRAME, EVENT_INCLINOMETER
from softloop.plant.setup import configure_inclinometer
from softloop.wire.can_config import CanConfig, open_port
from softloop.wire.pace import WIRE_ANALOG, WIRE_DRIVER, WIRE_INCLINOMETER
from softloop.wire.serial_urls import open_serial
from softloop.wire.shell import Context

# Frames that may be missing in a row before the driver refuses the next one: as many as its watchdog lets pass at 200 Hz.
_MAX_DELTA = 4
_FOREVER_NS = 1 << 62
_ANSWER = 0  # a kind beside those of EVENT: bytes that the inclinometer answers
# Interfaces that hand a frame over without the time it takes on a wire; on a real bus it arrives at its end.
_WITHOUT_WIRE = ("zenoh", "virtual", "udp_multicast")

Item = tuple[int, int, Any]


class Outbox:
    """What is under way on the wires, by the time at which it has arrived."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, int, Any]] = []
        self._order = count()

    @property
    def next_ns(self) -> int:
        """When the next piece has arrived."""
        return self._heap[0][0] if self._heap else _FOREVER_NS

    def add(self, end_ns: int, kind: int, content: Any) -> None:
        heapq.heappush(self._heap, (end_ns, next(self._order), kind, content))

    def take(self, now_ns: int) -> list[Item]:
        """(end_ns, kind, content) of all that has arrived by `now_ns`, in order."""
        taken: list[Item] = []
        while self._heap and self._heap[0][0] <= now_ns:
            end_ns, _, kind, content = heapq.heappop(self._heap)
            taken.append((end_ns, kind, content))
        return taken


class CanSide:
    """Valve driver and analogue module on their bus or buses."""

    def __init__(self, config: PlantProcess, context: Context) -> None:
        plant = config.plant
        self._clock, self._pace = context.clock, context.pace
        self._receiver = E2eReceiver(VALVE_COMMAND_ID, _MAX_DELTA)
        self._counter = 0
        self._valves = open_port(config.valves_bus, plant.can_valves, context.wire, context.clock, (VALVE_COMMAND_ID,))
        self._analog = self._valves
        if plant.can_analog != plant.can_valves:
            self._analog = open_port(config.analog_bus, plant.can_analog, context.wire, context.clock, ())
        self._frame_ns = can_frame_ns(DLC, config.valves_bus.bitrate)
        self._commands = self._pace.valve_frames(self._valves, self._frame_ns)
        self._driver_stamp_ns = _time_before_end(config.valves_bus)
        self._analog_stamp_ns = _time_before_end(config.analog_bus)

    def take_commands(self, params: Any, state: Any) -> None:
        """Give the driver all valve frames that have come and are good."""
        while (frame := self._commands.recv(0.0)) is not None:
            if frame.flags or frame.arbitration_id != VALVE_COMMAND_ID:
                continue
            data = bytes(frame.data[: frame.dlc])
            if not self._receiver.judge(data).usable:
                continue
            command = decode_valve_command(data)
            end_ns = min(frame.stamp_ns + self._driver_stamp_ns, self._clock.now_ns() + self._frame_ns)
            accept_command(params, state, end_ns, command.charge_counts, command.exhaust_counts, command.output, command.seq)

    def send(self, kind: int, raw: list[int], end_ns: int) -> bool:
        """Send a frame whose end on the wire is `end_ns`; False when this kind is not CAN's."""
        if kind == EVENT_DRIVER_FRAME:
            status = ValveStatusFrame(self._counter, raw[2], raw[0], raw[1], raw[3])
            self._counter = next_counter(self._counter)
            self._valves.send(VALVE_STATUS_ID, encode_valve_status(status), end_ns - self._driver_stamp_ns)
            self._pace.note_piece(WIRE_DRIVER, 1, end_ns)
        elif kind == EVENT_ANALOG_FRAME:
            data = encode_analog_inputs(AnalogFrame(raw[0], raw[1], raw[2]))
            self._analog.send(ANALOG_INPUTS_ID, data, end_ns - self._analog_stamp_ns)
            self._pace.note_piece(WIRE_ANALOG, 1, end_ns)
        else:
            return False
        return True

    def close(self) -> None:
        self._valves.close()
        if self._analog is not self._valves:
            self._analog.close()


def _time_before_end(bus: CanConfig) -> int:
    """From a frame's stamp to its end. Without a wire it is stamped when handed over; a real wire's port stamps it at its end."""
    return can_frame_ns(DLC, bus.bitrate) if bus.interface in _WITHOUT_WIRE else 0


class SerialSide:
    """The inclinometer's end of the serial line. Nobody has to read at the other."""

    def __init__(self, plant: PlantConfig, context: Context, device: InclinometerDevice) -> None:
        url = plant.serial.replace("{run_dir}", str(context.run_dir.resolve()))
        self._clock, self._pace = context.clock, context.pace
        self._device = device
        self._port = open_serial(url, plant.baud, 0.0)

    def listen(self, params: Any, state: Any, outbox: Outbox) -> None:
        """Take the host's commands; what the device answers goes on its way."""
        data = self._port.read(256)
        if not data:
            return
        now_ns = self._clock.now_ns()
        answer = self._device.feed(data, now_ns)
        configure_inclinometer(params, state, self._device)
        if answer:
            outbox.add(now_ns + serial_ns(len(answer), self._device.baud), _ANSWER, answer)

    def send(self, kind: int, content: Any, end_ns: int) -> None:
        """Send what has come to its end; what the port does not take at once is lost, as on a line without a reader."""
        data = self._device.packets(content[2], content[0], content[1]) if kind == EVENT_INCLINOMETER else content
        with contextlib.suppress(serial.SerialTimeoutException):
            self._port.write(data)
        self._pace.note_piece(WIRE_INCLINOMETER, len(data), end_ns)

    def close(self) -> None:
        self._port.close()
