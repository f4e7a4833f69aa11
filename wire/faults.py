"""Faults injected into what a process hears and says: CAN frames, serial bytes, Zenoh samples, sensor values.

A process asks its context for its wires, and gets them as they are, or, where `[faults]` names one, with a line between
(`fault_line`). So adapters, gate and controller cannot tell, and it is the same on a real bus and a real port. It stands behind
`wire.pace`: at lockstep pace what is announced has come before it is lost here.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from random import Random
from threading import Lock
from typing import TYPE_CHECKING, Protocol

from softloop.wire.can_errors import ErrorCounters, NodeState, bus_error_frame, state_frame
from softloop.wire.can_frame import CanFrame
from softloop.wire.channels import VALVES, Channel
from softloop.wire.clock import Clock
from softloop.wire.fault_config import FaultsConfig
from softloop.wire.fault_line import Line, Strike, flip_bits
from softloop.wire.messages import CDR_HEADER, BadPayload, constant, message, names_of
from softloop.wire.pace import WIRE_ANALOG, WIRE_DRIVER, WIRE_INCLINOMETER, ByteSource, FrameSource
from softloop.wire.session import Wire

if TYPE_CHECKING:
    from softloop.wire.can_port import CanPort
    from softloop.wire.shell import Context

Put = Callable[[bytes], None]
NUMBERS = {name: number for number, name in names_of("Event", "FAULT_").items()}
KIND_FAULT = constant("Event", "KIND_FAULT")
_ARMED = constant("ValveStatus", "GATE_ARMED")
_WIRES = {WIRE_ANALOG: "analog", WIRE_DRIVER: "driver", WIRE_INCLINOMETER: "inclinometer"}
_FIELDS = {
    "chamber_pressure": ("pressure", "chamber_pressure_kpa"),
    "supply_pressure": ("pressure", "supply_pressure_kpa"),
    "angle": ("inclination", "angle_deg"),
    "rate": ("inclination", "rate_deg_s"),
}
_MANY = 256
_MS = 1_000_000


class FrameSink(Protocol):
    """Where frames go: a `CanPort`."""

    def send(self, arbitration_id: int, data: bytes, stamp_ns: int) -> bool: ...


class NoFaults:
    """The wires as they are."""

    def of(self, family: str, target: str) -> list[Strike]:
        """What is done to a target."""
        return []

    def frames(self, source: FrameSource, port: CanPort, wire: int) -> FrameSource:
        """The frames of one of the rig's wires (WIRE_*), which come by way of `port`."""
        return source

    def sender(self, port: CanPort) -> FrameSink:
        """Where the gate's valve frames go."""
        return port

    def bytes(self, source: ByteSource, wire: int) -> ByteSource:
        """The bytes of one of the rig's wires."""
        return source


class Faults(NoFaults):
    """The wires of one process with what `[faults]` does to them."""

    def __init__(self, config: FaultsConfig, context: Context, source: int, armed_ns: Callable[[], int | None]) -> None:
        """`source`: Event SOURCE_* of the process; `armed_ns`: when the gate was armed, None before."""
        from softloop.wire.status import EventReporter  # noqa: PLC0415 - it reads the context, which holds this

        self._clock, self._pace = context.clock, context.pace
        self._reporter = EventReporter(context, source)
        self._strikes = [
            Strike(one, Random(f"{config.seed} {place} {context.process}"), armed_ns, self._teller(one.kind, one.size))
            for place, one in config.of_process(context.process)
        ]

    def _teller(self, kind: str, size: float) -> Callable[[int, int], None]:
        def tell(code: int, stamp_ns: int) -> None:
            self._reporter.say(KIND_FAULT, stamp_ns, code=code, reason=NUMBERS[kind], value=size)

        return tell

    def of(self, family: str, target: str) -> list[Strike]:
        """What is done to a target."""
        return [s for s in self._strikes if s.config.family == family and s.config.target == target]

    def frames(self, source: FrameSource, port: CanPort, wire: int) -> FrameSource:
        strikes = self.of("can", _WIRES[wire])
        return FaultyFrames(source, port, self._clock.now_ns, strikes) if strikes else source

    def sender(self, port: CanPort) -> FrameSink:
        strikes = self.of("can", "command")
        off = [s for s in self.of("can", "driver") if s.action == "bus_off"]
        return FaultySender(port, strikes, off, self._pace.note_sent) if strikes or off else port

    def bytes(self, source: ByteSource, wire: int) -> ByteSource:
        strikes = self.of("serial", _WIRES[wire])
        return FaultyBytes(source, self._clock.now_ns, strikes) if strikes else source

    def spoil(self, channel: Channel, put: Put) -> Put:
        """`put` of a channel with what is done to its samples and their values."""
        strikes = [s for s in self._strikes if channel.name == _channel_of(s)]
        return spoiled_put(channel, put, self._clock.now_ns, strikes) if strikes else put


def _channel_of(strike: Strike) -> str:
    """The channel on whose samples a strike acts; empty where on none."""
    family, target = strike.config.family, strike.config.target
    if family == "sensor":
        return _FIELDS[target][0]
    return target if family == "zenoh" else ""


def install(config: FaultsConfig, context: Context, source: int, armed_ns: Callable[[], int | None]) -> None:
    """Let a process hear and say what `[faults]` makes of it; nothing changes where that names none of its wires."""
    if config.of_process(context.process):
        faults = Faults(config, context, source, armed_ns)
        context.faults, context.wire.spoil = faults, faults.spoil
        steps = faults.of("clock", context.process)
        if steps:
            context.pace.clock = SteppedClock(context.clock, steps)


class SteppedClock:
    """A clock that jumps, and jumps back when that is over. For wall pace; asked by any thread."""

    def __init__(self, clock: Clock, strikes: list[Strike]) -> None:
        self._clock, self._strikes, self._lock = clock, strikes, Lock()

    def _ahead_ns(self, now_ns: int) -> int:
        with self._lock:
            return sum(round(s.config.size * _MS) for s in self._strikes if s.on(now_ns))

    def now_ns(self) -> int:
        now_ns = self._clock.now_ns()
        return now_ns + self._ahead_ns(now_ns)

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Until its own time is `deadline_ns`, as it goes at the start of the sleep."""
        self._clock.sleep_until_ns(deadline_ns - self._ahead_ns(self._clock.now_ns()))


def when_armed(wire: Wire) -> Callable[[], int | None]:
    """A function that gives the rig clock of the gate's first word that it is armed; None before. For wall pace."""
    newest = wire.latest(VALVES)
    found: list[int] = []

    def armed_ns() -> int | None:
        payload = None if found else newest.take()
        if payload is not None:
            try:
                status = message("ValveStatus").unpack(payload)
            except BadPayload:
                return None
            if status.gate == _ARMED:
                found.append(int(status.stamp_ns))
        return found[0] if found else None

    return armed_ns


class FaultyFrames:
    """Frames that come in over a bus in trouble."""

    def __init__(self, source: FrameSource, port: CanPort, now_ns: Callable[[], int], strikes: list[Strike]) -> None:
        self._source, self._port, self._now_ns = source, port, now_ns
        self._off = [s for s in strikes if s.action == "bus_off"]
        self._errors = [s for s in strikes if s.action == "error_frames"]
        self._line = Line([s for s in strikes if s not in self._off + self._errors], _spoil_frame)
        self._counters, self._was_off = ErrorCounters(), False

    def recv(self, timeout_s: float = 0.0) -> CanFrame | None:
        """As `CanPort.recv`; who waits gets None where the frame that came is lost."""
        for _ in range(_MANY):
            frame = self._line.take(self._now_ns())
            if frame is not None:
                return frame
            fresh = self._source.recv(timeout_s)
            if fresh is not None:
                self._pass(fresh, self._now_ns())
            if fresh is None or timeout_s > 0:
                break
        return self._line.take(self._now_ns())

    def _pass(self, frame: CanFrame, now_ns: int) -> None:
        off = any(s.on(now_ns) for s in self._off)
        if off or self._was_off:
            self._be_off(frame, off=off)
        if off:
            return
        for strike in self._errors:
            if strike.hits(now_ns):
                self._err(frame, now_ns)
        self._line.put(frame, now_ns)

    def _be_off(self, frame: CanFrame, *, off: bool) -> None:
        """Tell the port, also again after each frame that it has really received."""
        counters = ErrorCounters(transmit=256, off=True) if off else ErrorCounters()
        before = NodeState.PASSIVE if off else NodeState.BUS_OFF
        said = state_frame(counters, before, frame.seq, frame.stamp_ns, frame.node)
        if said is not None:
            self._port.note(said)
        self._was_off = off

    def _err(self, frame: CanFrame, now_ns: int) -> None:
        """A frame that was destroyed once before it came: an error frame, and a word when the node's state changes."""
        before = self._counters.state
        self._counters.receive_failed()
        stamp = frame.seq, frame.stamp_ns, frame.node
        self._line.put(bus_error_frame(self._counters, *stamp), now_ns)
        said = state_frame(self._counters, before, *stamp)
        if said is not None:
            self._port.note(said)
            self._line.put(said, now_ns)


class FaultySender:
    """The gate's end of the valve wire. A frame that is lost here is, for the gate, one that the bus did not take."""

    def __init__(self, port: FrameSink, strikes: list[Strike], off: list[Strike], note_sent: Callable[[int], None]) -> None:
        """`note_sent`: told of each frame that goes out beside the one that `send` answers for."""
        self._port, self._off, self._note_sent = port, off, note_sent
        self._line: Line[tuple[int, bytes]] = Line(strikes, lambda frame, strike: (frame[0], flip_bits(frame[1], strike)))

    def send(self, arbitration_id: int, data: bytes, stamp_ns: int) -> bool:
        """As `CanPort.send`; what was held back goes out with the next frame that passes."""
        if any(s.on(stamp_ns) for s in self._off):
            return False
        self._line.put((arbitration_id, data), stamp_ns)
        sent = sum([self._port.send(number, content, stamp_ns) for number, content in self._line.take_all(stamp_ns)])
        for _ in range(sent - 1):
            self._note_sent(stamp_ns)
        return sent > 0


class FaultyBytes:
    """Bytes that come in over a bad line; each is hit by itself."""

    def __init__(self, source: ByteSource, now_ns: Callable[[], int], strikes: list[Strike]) -> None:
        self._source, self._now_ns = source, now_ns
        self._line: Line[bytes] = Line(strikes, flip_bits)

    def read(self, timeout_s: float) -> bytes:
        """As of the source; empty also where all that came is lost or late."""
        data = self._source.read(timeout_s)
        now_ns = self._now_ns()
        for i in range(len(data)):
            self._line.put(data[i : i + 1], now_ns)
        return b"".join(self._line.take_all(now_ns))


def spoiled_put(channel: Channel, put: Put, now_ns: Callable[[], int], strikes: list[Strike]) -> Put:
    """`put` over a line with injections; what was late goes with the next sample that is put."""

    def alter(payload: bytes, strike: Strike) -> bytes:
        if strike.config.family == "sensor":
            return spoiled_value(channel, payload, strike)
        return flip_bits(payload, strike, len(CDR_HEADER))

    line = Line(strikes, alter)

    def put_spoiled(payload: bytes) -> None:
        now = now_ns()
        line.put(payload, now)
        for late in line.take_all(now):
            put(late)

    return put_spoiled


def spoiled_value(channel: Channel, payload: bytes, strike: Strike) -> bytes:
    """The message in `payload` with one value stuck, shifted, noisy or no number."""
    name = _FIELDS[strike.config.target][1]
    at = len(CDR_HEADER) + next(f.offset for f in message(channel.message).fields if f.name == name)
    (value,) = struct.unpack_from("<d", payload, at)
    spoiled = bytearray(payload)
    struct.pack_into("<d", spoiled, at, _spoiled(value, strike))
    return bytes(spoiled)


def _spoiled(value: float, strike: Strike) -> float:
    if strike.action == "stuck":
        strike.held = value if strike.held is None else strike.held
        return strike.held
    if strike.action == "bias":
        return value + strike.config.size
    if strike.action == "noise":
        return value + strike.random.gauss(0.0, strike.config.size)
    return float("nan")


def _spoil_frame(frame: CanFrame, strike: Strike) -> CanFrame:
    return frame._replace(data=flip_bits(frame.data, strike, 0, frame.dlc))
