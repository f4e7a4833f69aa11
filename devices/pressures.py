"""The process `pressures`: the analogue module's frames on CAN become pressure samples."""

from __future__ import annotations

from softloop.devices.config import ANALOG_DLC, PressuresProcess, SensorConfig, analog_config
from softloop.devices.protocols import can_frames
from softloop.devices.protocols.analog import NOTHING, AnalogState, analog_step
from softloop.devices.protocols.quantise import counts_to_kpa
from softloop.wire.can_config import open_port
from softloop.wire.can_frame import CanFrame
from softloop.wire.can_port import CanPort
from softloop.wire.channels import PRESSURE
from softloop.wire.messages import constant, message
from softloop.wire.pace import WIRE_ANALOG
from softloop.wire.shell import Context, say
from softloop.wire.status import EventReporter, StatusReporter

_SAMPLE = message("PressureSample")
_OK, _OUT_OF_RANGE = constant("PressureSample", "STATUS_OK"), constant("PressureSample", "STATUS_OUT_OF_RANGE")
_SOURCE, _KIND_BUS = constant("Event", "SOURCE_PRESSURES"), constant("Event", "KIND_BUS")
_WAIT_S = 0.05
_SILENCE_NS = 1_000_000_000


def run(config: PressuresProcess, context: Context) -> None:
    """Publish one sample for each frame of the module until asked to stop.

    Raises:
        Unavailable: the CAN bus cannot be opened.
        Lost: it went away.
    """
    port = open_port(config.bus, config.pressures.can, context.wire, context.clock, [can_frames.ANALOG_INPUTS_ID])
    try:
        loop = PressuresLoop(config, context, port)
        frames = context.frames(port, WIRE_ANALOG)
        context.enter_loop()
        while not context.stop:
            frame = frames.recv(_WAIT_S)
            if frame is not None:
                loop.take(frame)
            loop.keep_time()
        loop.status.close()
    finally:
        port.close()


class PressuresLoop:
    """From frames to samples, counting what is missing."""

    def __init__(self, config: PressuresProcess, context: Context, port: CanPort) -> None:
        self.config = config.pressures
        self.context, self.clock, self.port = context, context.clock, port
        self.bounds, self.state = analog_config(config), AnalogState()
        self.heard_ns, self.silent = context.clock.now_ns(), False
        self.put = context.wire.publisher(PRESSURE)
        self.status, self.events = StatusReporter(context, _SOURCE), EventReporter(context, _SOURCE)

    def take(self, frame: CanFrame) -> None:
        """Publish the sample in a frame; what is no frame of the module is counted as dropped."""
        if frame.flags != 0 or frame.arbitration_id != can_frames.ANALOG_INPUTS_ID or frame.dlc != ANALOG_DLC:
            self.status.dropped += 1
            return
        received_ns = self.clock.now_ns()
        inputs = can_frames.decode_analog_inputs(frame.data)
        supply_kpa = _pressure(self.config.supply, inputs.supply_counts)
        chamber_kpa = _pressure(self.config.chamber, inputs.chamber_counts)
        state = self.state
        if analog_step(self.bounds, state, inputs.counter, supply_kpa, chamber_kpa, frame.stamp_ns, received_ns) == NOTHING:
            self.status.dropped += 1  # the same frame again
            return
        self.heard_ns = received_ns
        sample = _SAMPLE.make(
            seq=state.seq,
            stamp_ns=state.stamp_ns,
            received_ns=received_ns,
            published_ns=self.clock.now_ns(),
            supply_pressure_kpa=supply_kpa,
            chamber_pressure_kpa=chamber_kpa,
            missed=state.missed,
            status=_OK if state.in_range else _OUT_OF_RANGE,
        )
        self.put(_SAMPLE.pack(sample))

    def keep_time(self) -> None:
        """The status of each second, and a word when the module falls silent or is back."""
        self.status.cycle()
        now_ns = self.clock.now_ns()
        silent = now_ns - self.heard_ns > _SILENCE_NS
        if silent != self.silent:
            self.silent = silent
            self.events.say(_KIND_BUS, now_ns, code=int(silent))
            what = "nothing is heard from" if silent else "there is"
            say(self.context.process, f"{what} the analogue module on CAN bus '{self.port.name}'")


def _pressure(sensor: SensorConfig, counts: int) -> float:
    return counts_to_kpa(counts, sensor.zero_v, sensor.full_v, sensor.span_kpa)
