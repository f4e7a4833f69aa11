"""The process `valves`: the safety gate between the controller and the valve driver on CAN.

It wakes on each command, or, when none comes, a little after it was due; each time it runs `gate_step` once and sends one
valve frame, in the words of the driver that the bench file names. What happens without it: the driver vents by itself.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from softloop.devices import gate as g
from softloop.devices.config import PERIOD_NS, ValvesProcess
from softloop.devices.gate_messages import COMMAND as COMMAND_DTYPE
from softloop.devices.gate_messages import FRAME, fill_status_of_arrays, give_command_of_arrays
from softloop.devices.gate_messages import STATUS as STATUS_DTYPE
from softloop.devices.protocols.quantise import counts_to_current
from softloop.devices.valve_driver import ValveDriver, make_driver
from softloop.wire.can_config import open_port
from softloop.wire.can_port import CanPort
from softloop.wire.channels import ARM, COMMAND, REQUEST, VALVES, key
from softloop.wire.errors import Lost
from softloop.wire.messages import BadPayload, constant, message, names_of
from softloop.wire.pace import WIRE_DRIVER
from softloop.wire.shell import Context, say
from softloop.wire.status import EventReporter, StatusReporter

_COMMAND, _REQUEST, _STATUS = message("ValveCommand"), message("GateRequest"), message("ValveStatus")
_STOP, _FAULT, _DISARM, _ARM = (constant("GateRequest", f"ACTION_{a}") for a in ("STOP", "FAULT", "DISARM", "ARM"))
_STOPS = {_STOP: g.STOP_ASKED, _FAULT: g.STOP_INVARIANT}
_SOURCE = constant("Event", "SOURCE_GATE")
_KIND_GATE, _KIND_DRIVER, _KIND_BUS = (constant("Event", f"KIND_{k}") for k in ("GATE", "DRIVER", "BUS"))
_GATES, _REASONS = names_of("ValveStatus", "GATE_"), names_of("ValveStatus", "REASON_")
_INT63 = 2**63 - 1  # what of a requester's number the gate compares
_FRAMES_AT_ONCE = 64  # a babbling bus must not keep the gate from its own frame
_SHUTDOWN_FRAMES = 5
_PATIENCE_NS = 1_000_000_000  # for the driver's first word


def run(config: ValvesProcess, context: Context) -> None:
    """Run the gate until asked to stop, then vent.

    Raises:
        Unavailable: the CAN bus cannot be opened, or the driver would not vent by itself.
        Lost: it went away.
    """
    driver = make_driver(config)
    port = open_port(config.bus, config.valves.can, context.wire, context.clock, driver.receive)
    try:
        driver.prepare(port, context.clock)
        loop = ValvesLoop(config, context, port, driver)
        context.enter_loop()
        while not context.stop:
            loop.wait()
            loop.read()
            loop.step()
            loop.write()
        loop.shut_down()
    finally:
        port.close()


class ValvesLoop:
    """The gate's wires, and what it keeps between two wakes."""

    def __init__(self, config: ValvesProcess, context: Context, port: CanPort, driver: ValveDriver) -> None:
        self.context, self.clock, self.port, self.driver = context, context.clock, port, driver
        self.wait_ns = PERIOD_NS + round(config.valves.command_wait_ms * 1e6)
        self.records = [np.zeros(1, d) for d in (g.GATE_CONFIG, g.GATE_STATE, g.GATE_INPUT, g.GATE_OUTPUT)]
        self.records[0][0] = g.gate_config(config)
        self.state, self.given, self.output = (record[0] for record in self.records[1:])  # views
        self.command, self.frame, self.word = np.zeros(1, COMMAND_DTYPE), np.zeros(1, FRAME), np.zeros(1, STATUS_DTYPE)
        self.command_bytes = self.command.view("u1")
        self.seq = self.tick = self.bus_offs = self.late_ns = 0
        self.said_driver, self.said_refusal, self.was_off = g.DRIVER_SILENT, 0, False
        self.lost: Lost | None = None
        self._warm()
        self.commands = context.pace.commands(context.wire.inbox(COMMAND))
        self.requests = context.pace.requests(context.wire.inbox(REQUEST, ARM))
        self.arm_key = key(context.bench, ARM)
        self.driver_frames = context.frames(port, WIRE_DRIVER)
        self.sender = context.faults.sender(port)
        self.put = context.wire.publisher(VALVES)
        self.status, self.events = StatusReporter(context, _SOURCE), EventReporter(context, _SOURCE)
        self.began_ns = self.clock.now_ns()
        self.deadline_ns = self.began_ns + PERIOD_NS

    def _warm(self) -> None:
        """Compile and load all that the loop uses, on records of its own."""
        state, given, output = (record.copy() for record in self.records[1:])
        g.gate_step_of_arrays(self.records[0], state, given, output)
        give_command_of_arrays(given, self.command, 0)
        fill_status_of_arrays(self.frame, given, state, output, self.word)

    def wait(self) -> None:
        """Return at the next command, or at the deadline; notes which."""
        self.given.command_new = 0
        while not self.context.stop:
            left_s = (self.deadline_ns - self.clock.now_ns()) * 1e-9
            taken = self.commands.take(left_s) if left_s > 0 else None
            now_ns = self.clock.now_ns()
            if taken is not None:
                if self._take_newest(taken[1], now_ns):
                    return
            elif now_ns >= self.deadline_ns:
                self._be_silent(now_ns)
                return

    def _take_newest(self, payload: bytes, now_ns: int) -> bool:
        payloads = [payload, *(p for _, p in self.commands.take_all())]
        self.status.dropped += len(payloads) - 1
        try:
            _COMMAND.unpack_into(payloads[-1], self.command_bytes)
        except BadPayload:
            self.status.dropped += 1
            return False
        give_command_of_arrays(self.records[2], self.command, now_ns)
        self.tick = int(self.command["tick"][0])
        self.deadline_ns = now_ns + self.wait_ns
        self.late_ns = 0
        return True

    def _be_silent(self, now_ns: int) -> None:
        self.late_ns = late_ns = now_ns - self.deadline_ns
        self.tick += 1
        self.deadline_ns = self.deadline_ns + PERIOD_NS if late_ns < PERIOD_NS else now_ns + PERIOD_NS

    def read(self) -> None:
        """Requests, and what the driver and the bus say."""
        given = self.given
        given.stop = given.disarm = given.arm = 0
        for full_key, payload in self.requests.take_all():
            try:
                request = _REQUEST.unpack(payload)
            except BadPayload:
                self.status.dropped += 1
                continue
            # Access rules go by keys: who may only stop the rig shall not arm it under another key.
            if (request.action == _ARM) != (full_key == self.arm_key):
                self.status.dropped += 1
                continue
            given.stop |= _STOPS.get(request.action, 0)
            given.disarm |= request.action == _DISARM
            if request.action == _ARM:
                self._take_arm(request)
        try:
            self._read_bus()
        except Lost as error:
            self.lost = error
        given.bus_off = self.lost is not None or self.port.bus_off or self.port.bus_offs != self.bus_offs
        self.bus_offs = self.port.bus_offs

    def _take_arm(self, request: Any) -> None:
        given = self.given
        if given.arm:  # two at once: the step judges the last one, and the one before is used up too
            g.arm_is_new(self.state, given.arm_origin, given.arm_seq, self.clock.now_ns())
        given.arm, given.arm_origin, given.arm_seq = 1, request.origin & _INT63, request.seq & _INT63
        given.arm_stamp_ns = request.stamp_ns

    def _read_bus(self) -> None:
        for _ in range(_FRAMES_AT_ONCE):
            frame = self.driver_frames.recv(0.0)
            if frame is None:
                return
            word = self.driver.hear(frame) if frame.flags == 0 else None
            if word is not None:
                self.given.driver = word
                self.given.driver_stamp_ns = min(frame.stamp_ns, self.clock.now_ns())
            if word == g.DRIVER_WATCHDOG:
                return  # to be judged before what comes after it

    def step(self) -> None:
        """The gate's judgement, now."""
        self.given.now_ns = self.clock.now_ns()
        g.gate_step_of_arrays(*self.records)

    def write(self) -> None:
        """One valve frame, then the word on it. Raises Lost when the bus went away, after saying so on Zenoh."""
        output = self.output
        self.seq += 1
        counts = int(output.charge_counts), int(output.exhaust_counts)
        frames = self.driver.frames(int(output.output), *counts, self.seq)
        output.charge_current_ma, output.exhaust_current_ma = (counts_to_current(self.driver.realised(c)) for c in counts)
        stamp_ns = self.clock.now_ns()
        if self.lost is None:
            try:
                self._send(frames, stamp_ns)
            except Lost as error:
                self.lost = error
        self._publish(stamp_ns)
        self._say(stamp_ns)
        self.status.cycle(late_ns=self.late_ns, skipped=self.late_ns // PERIOD_NS)
        if self.lost is not None:
            raise self.lost

    def _send(self, frames: list[tuple[int, bytes]], stamp_ns: int) -> None:
        for place, (arbitration_id, data) in enumerate(frames):
            if not self.sender.send(arbitration_id, data, stamp_ns):
                self.status.dropped += 1
            elif place == 0:
                self.context.pace.note_sent(stamp_ns)

    def _publish(self, stamp_ns: int) -> None:
        driver = self.driver
        self.frame[0] = (self.seq, stamp_ns, self.tick, *driver.coils, driver.rejected)
        fill_status_of_arrays(self.frame, self.records[2], self.records[1], self.records[3], self.word)
        self.put(_STATUS.pack_record(self.word[0]))

    def _say(self, stamp_ns: int) -> None:
        """Events of this step, and lines for a person."""
        output, at = self.output, {"stamp_ns": stamp_ns, "tick": self.tick}
        if output.changed:
            gate, reason = int(output.gate), int(output.reason)
            self.events.say(_KIND_GATE, code=gate, reason=reason, **at)
            say(self.context.process, f"gate {_GATES[gate]}" + (f": {_REASONS[reason]}" if reason else ""))
            self.said_refusal = 0
        if output.refused:
            refused = int(output.refused)
            self.events.say(_KIND_GATE, code=int(output.gate), reason=refused, **at)
            if refused != self.said_refusal:
                say(self.context.process, f"not armed: {_REASONS[refused]}")
            self.said_refusal = refused
        self._say_driver(int(output.driver), stamp_ns)
        if bool(self.given.bus_off) != self.was_off:
            self.was_off = not self.was_off
            self.events.say(_KIND_BUS, code=1 if self.was_off else 0, **at)

    def _say_driver(self, driver: int, stamp_ns: int) -> None:
        bus = f"the valve driver on CAN bus '{self.port.name}'"
        if driver != self.said_driver:
            self.events.say(_KIND_DRIVER, stamp_ns, code=driver, tick=self.tick)
            if driver == g.DRIVER_SILENT:
                say(self.context.process, f"{bus} is silent; the gate stays or goes to a safe state")
            self.said_driver = driver
        elif driver == g.DRIVER_SILENT and self.began_ns and stamp_ns - self.began_ns > _PATIENCE_NS:
            self.began_ns = 0
            say(
                self.context.process,
                f"nothing is heard from {bus}; the gate will not arm. Is it powered, and the bus the right one?",
            )

    def shut_down(self) -> None:
        """Disarm and send a few vent frames, so that one of them arrives."""
        self.given.shutdown = 1
        for _ in range(_SHUTDOWN_FRAMES):
            self.given.command_new = 0
            self.read()
            self.step()
            self.write()
            self.clock.sleep_until_ns(self.clock.now_ns() + PERIOD_NS)
        self.status.close()
