"""The 5 ms process: read the newest samples, tick, write the command, keep time."""

from __future__ import annotations

from typing import Any

import numpy as np

from softloop.controller.command import COMMAND, fill_command_of_arrays
from softloop.controller.config import ControllerConfig
from softloop.controller.records import INPUTS, PHASE_WAIT
from softloop.controller.setup import PERIOD_NS, Controller, build
from softloop.wire import channels
from softloop.wire.channels import CYCLE, INCLINATION, PRESSURE, VALVES
from softloop.wire.clock import Deadlines
from softloop.wire.messages import BadPayload, constant, message
from softloop.wire.shell import Context
from softloop.wire.status import EventReporter, StatusReporter

_SOURCE = constant("Event", "SOURCE_CONTROLLER")
_KIND_PHASE = constant("Event", "KIND_PHASE")
_KIND_OVERRUN = constant("Event", "KIND_OVERRUN")


def run(config: ControllerConfig, context: Context) -> None:
    """Run the controller until asked to stop. Raises BadFile or BadConfig before the loop starts."""
    loop = ControllerLoop(build(config), context)
    loop.warm()
    context.enter_loop()
    deadlines = Deadlines(PERIOD_NS, context.clock.now_ns() + PERIOD_NS)
    while not context.stop:
        context.clock.sleep_until_ns(deadlines.next_ns)
        loop.read(deadlines)
        loop.controller.tick()
        loop.write()
        deadlines.advance(context.clock.now_ns())
    loop.close()


class ControllerLoop:
    """The process's inputs, outputs and what it keeps between ticks."""

    def __init__(self, controller: Controller, context: Context) -> None:
        wire = context.wire
        self.controller = controller
        self.clock = context.clock
        pace = context.pace
        self.inputs = [self._input(pace.newest(wire.latest(c), *source), name) for c, name, source in _INPUTS]
        self.put_command, self.put_cycle = wire.publisher(channels.COMMAND), wire.publisher(CYCLE)
        self.status = StatusReporter(context, _SOURCE)
        self.events = EventReporter(context, _SOURCE)
        self.kind, self.command, self.record = message("ValveCommand"), np.zeros(1, COMMAND), message("CycleRecord")
        self.phase = PHASE_WAIT
        self.woken_ns = 0

    def _input(self, latest: Any, field: str) -> tuple[Any, Any, Any]:
        """(source, message type, view of the bytes it is copied to) of one field of `INPUTS`."""
        offset = INPUTS.fields[field][1]  # type: ignore[index]
        kind = message(INPUT_MESSAGES[field])
        raw = self.controller.inputs.view("u1")[offset : offset + kind.cdr_size]
        return latest, kind, raw

    def warm(self) -> None:
        """One tick on empty inputs, so that nothing is loaded or compiled once the loop runs; then start afresh."""
        before = self.controller.state.copy()
        self.controller.tick()
        fill_command_of_arrays(self.controller.cycle, self.command)
        self.controller.state[:] = before

    def read(self, deadlines: Deadlines) -> None:
        """The newest sample of every input; one that cannot be read leaves the last good one, whose age will tell."""
        self.woken_ns = self.clock.now_ns()
        inputs = self.controller.inputs[0]
        inputs.now_ns, inputs.tick, inputs.skipped = deadlines.next_ns, deadlines.tick, deadlines.skipped
        for latest, kind, raw in self.inputs:
            payload = latest.take()
            if payload is not None:
                try:
                    kind.unpack_into(payload, raw)
                except BadPayload:
                    self.status.dropped += 1

    def write(self) -> None:
        """Command first, then what is only for the log."""
        cycle = self.controller.cycle[0]
        cycle.woken_ns = self.woken_ns
        cycle.computed_ns = self.clock.now_ns()
        fill_command_of_arrays(self.controller.cycle, self.command)
        self.put_command(self.kind.pack_record(self.command[0]))
        cycle.published_ns = self.clock.now_ns()
        self.put_cycle(self.record.pack_record(cycle))
        if cycle.phase != self.phase:
            self.events.say(_KIND_PHASE, int(cycle.stamp_ns), code=int(cycle.phase), tick=int(cycle.tick))
            self.phase = int(cycle.phase)
        if cycle.skipped:
            self.events.say(_KIND_OVERRUN, int(cycle.stamp_ns), value=float(cycle.skipped), tick=int(cycle.tick))
        self.status.cycle(late_ns=self.woken_ns - int(cycle.stamp_ns), skipped=int(cycle.skipped))

    def close(self) -> None:
        """Say that this process ends."""
        self.status.close()


# Channel, field of `INPUTS`, and who sends it, the gate one tick after.
_INPUTS = (
    (PRESSURE, "pressure", ("pressures",)),
    (INCLINATION, "inclination", ("inclinometer",)),
    (VALVES, "valves", ("valves", 1)),
)
INPUT_MESSAGES = {"pressure": PRESSURE.message, "inclination": INCLINATION.message, "valves": VALVES.message}
