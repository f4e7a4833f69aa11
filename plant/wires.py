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
from softloop.plant.bus_end import BusEnd, BusEnds
from softloop.plant.config import PlantConfig, PlantProcess
from softloop.plant.electrical import accept_command
from softloop.plant.inclinometer_device import InclinometerDevice
from softloop.plant.records import EVENT_ANALOG_FRAME, EVENT_DRIVER_FRAME, EVENT_INCLINOMETER
from softloop.plant.setup import configure_inclinometer
from softloop.wire.can_config import CanConfig, open_port
from softloop.wire.can_frame import CanFrame
from softloop.wire.can_owner import FOREVER_NS
from softloop.wire.pace import WIRE_ANALOG, WIRE_DRIVER, WIRE_INCLINOMETER
from softloop.wire.serial_urls import open_serial
from softloop.wire.shell import Context

# Frames that may be missing in a row before the driver refuses the next one: as many as its watchdog lets pass at 200 Hz.
_MAX_DELTA = 4
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
        return self._heap[0][0] if self._heap else FOREVER_NS

    def add(self, end_ns: int, kind: int, content: Any) -> None:
        heapq.heappush(self._heap, (end_ns, next(self._order), kind, content))

    def take(self, now_ns: int) -> list[Item]:
        """(end_ns, kind, content) of all that has arrived by `now_ns`, in order."""
        taken: list[Item] = []
        while self._heap and self._heap[0][0] <= now_ns:
            end_ns, _, kind, content = heapq.heappop(self._heap)
            taken.append((end_ns, kind, content))
        return taken


class Pipe:
    """The devices' end of a bus that carries their frames by itself: real, or without any time on its wire."""

    def __init__(self, config: CanConfig, name: str, context: Context, receive: tuple[int, ...]) -> None:
        self._port = open_port(config, name, context.wire, context.clock, receive)
        self._clock, self._frame_ns = context.clock, can_frame_ns(DLC, config.bitrate)
        self._frames = context.pace.valve_frames(self._port, self._frame_ns) if receive else self._port
        self._stamp_ns = _time_before_end(config)

    def take(self) -> list[CanFrame]:
        """The frames that have come, each with its end on the wire as its stamp."""
        taken = []
        while (frame := self._frames.recv(0.0)) is not None:
            end_ns = min(frame.stamp_ns + self._stamp_ns, self._clock.now_ns() + self._frame_ns)
            taken.append(frame._replace(stamp_ns=end_ns))
        return taken

    def send(self, arbitration_id: int, data: bytes, end_ns: int) -> None:
        """Send a frame whose end on the wire is `end_ns`."""
        self._port.send(arbitration_id, data, end_ns - self._stamp_ns)

    def close(self) -> None:
        self._port.close()


class CanSide:
    """Valve driver and analogue module on their bus or buses, each a pipe or one in time (`plant.bus_end`)."""

    def __init__(self, config: PlantProcess, context: Context) -> None:
        plant = config.plant
        self._pace = context.pace
        self._receiver = E2eReceiver(VALVE_COMMAND_ID, _MAX_DELTA)
        self._counter = 0
        self._valves: Pipe | BusEnd = _end(config.valves_bus, plant.can_valves, context, (VALVE_COMMAND_ID,))
        apart = plant.can_analog != plant.can_valves
        self._analog = _end(config.analog_bus, plant.can_analog, context, ()) if apart else self._valves
        ends = [self._valves, self._analog] if apart else [self._valves]
        self._pipes = [end for end in ends if isinstance(end, Pipe)]
        self._buses = BusEnds([end for end in ends if isinstance(end, BusEnd)], context)

    @property
    def next_ns(self) -> int:
        """When something is over on a bus in time."""
        return self._buses.next_ns

    def take_commands(self, params: Any, state: Any, now_ns: int) -> None:
        """Give the driver all valve frames that have come and are good, and the buses what is handed over."""
        for bus in self._buses.all:
            bus.take(now_ns)
        if isinstance(self._valves, Pipe):
            self._accept(params, state, self._valves.take())

    def move(self, params: Any, state: Any) -> None:
        """Bring the buses to where the rig is."""
        reached_ns = int(state["reached_ns"])
        for bus in self._buses.all:
            self._accept(params, state, bus.run_until(reached_ns))
        self._buses.tell(reached_ns)

    def _accept(self, params: Any, state: Any, frames: list[CanFrame]) -> None:
        for frame in frames:
            if frame.flags or frame.arbitration_id != VALVE_COMMAND_ID:
                continue
            data = bytes(frame.data[: frame.dlc])
            if self._receiver.judge(data).usable:
                command = decode_valve_command(data)
                counts = command.charge_counts, command.exhaust_counts
                accept_command(params, state, frame.stamp_ns, *counts, command.output, command.seq)

    def hand_over(self, kind: int, raw: list[int], end_ns: int) -> bool:
        """Let a device's frame wait for its bus; False where that is a pipe, or the kind is not CAN's."""
        end = {EVENT_DRIVER_FRAME: self._valves, EVENT_ANALOG_FRAME: self._analog}.get(kind)
        if not isinstance(end, BusEnd):
            return False
        end.hand_over(*self._frame(kind, raw), end_ns)
        return True

    def send(self, kind: int, raw: list[int], end_ns: int) -> bool:
        """Send a frame whose end on the pipe is `end_ns`; False when this kind is not CAN's."""
        wire = {EVENT_DRIVER_FRAME: WIRE_DRIVER, EVENT_ANALOG_FRAME: WIRE_ANALOG}.get(kind)
        if wire is None:
            return False
        end = self._valves if wire == WIRE_DRIVER else self._analog
        assert isinstance(end, Pipe)
        end.send(*self._frame(kind, raw), end_ns)
        self._pace.note_piece(wire, 1, end_ns)
        return True

    def _frame(self, kind: int, raw: list[int]) -> tuple[int, bytes]:
        if kind == EVENT_ANALOG_FRAME:
            return ANALOG_INPUTS_ID, encode_analog_inputs(AnalogFrame(raw[0], raw[1], raw[2]))
        status = ValveStatusFrame(self._counter, raw[2], raw[0], raw[1], raw[3])
        self._counter = next_counter(self._counter)
        return VALVE_STATUS_ID, encode_valve_status(status)

    def close(self) -> None:
        for pipe in self._pipes:
            pipe.close()
        self._buses.close()


def _end(config: CanConfig, name: str, context: Context, receive: tuple[int, ...]) -> Pipe | BusEnd:
    return Pipe(config, name, context, receive) if config.emulation is None else BusEnd(config, context)


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
