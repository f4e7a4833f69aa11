"""The process `plant`: the simulated rig at wall pace, on the wires that a real one has.

Each turn drains the valve bus first, lets the rig happen up to now, and sends what has arrived by now: a frame's or packet's
time on the wire is simulated by sending it at its end.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from softloop.plant.config import PlantProcess
from softloop.plant.electrical import next_event_ns, run_until
from softloop.plant.faults import begin_faults
from softloop.plant.injection import Injection
from softloop.plant.records import EVENT, EVENT_DRIVER, EVENT_FAULT, EVENT_LOAD, EVENT_TRUTH
from softloop.plant.setup import PERIOD_NS, WireTimes, new_device, new_state, plant_record
from softloop.plant.wires import CanSide, Outbox, SerialSide
from softloop.wire.channels import TRUTH
from softloop.wire.faults import when_armed
from softloop.wire.messages import constant, message
from softloop.wire.shell import Context
from softloop.wire.status import EventReporter, StatusReporter

SOURCE = constant("Event", "SOURCE_PLANT")
KIND_LOAD = constant("Event", "KIND_LOAD")
KIND_FAULT = constant("Event", "KIND_FAULT")
KIND_DRIVER = constant("Event", "KIND_DRIVER")
LATE_NS = 2_000_000  # a plant later than this makes a run no valid evidence
_EVENTS = 256


class Plant:
    """The rig, its wires, and its account of its own lateness."""

    def __init__(self, config: PlantProcess, context: Context) -> None:
        plant = config.plant
        self._clock, self._pace = context.clock, context.pace
        self._device = new_device(plant)
        self._params = plant_record(plant, WireTimes(config.valves_bus.bitrate, config.analog_bus.bitrate))
        self._events = np.zeros(_EVENTS, EVENT)
        self._waiting = self._params.faults.copy()
        self._armed_ns = when_armed(context.wire) if plant.faults_from == "armed" else None
        if self._armed_ns is not None:
            self._params.faults["kind"] = 0
        self._warm()
        self._outbox = Outbox()
        self._can = CanSide(config, context)
        self._serial = SerialSide(plant, context, self._device)
        self._truth_type = message("PlantTruth")
        self._put_truth = context.wire.publisher(TRUTH)
        self._status = StatusReporter(context, SOURCE)
        self._reporter = EventReporter(context, SOURCE)
        self._injection = Injection(context)
        self._late_max_ns = self._misses = 0
        self.start()

    def _begin(self, start_ns: int) -> Any:
        return new_state(self._params, self._device, start_ns)

    def _warm(self) -> None:
        """Run the kernels once on a rig of no consequence."""
        run_until(self._params, self._begin(0), 2 * PERIOD_NS, self._events)

    def start(self) -> None:
        """Let the rig's time begin now: at rest, vented."""
        self._state = self._begin(self._clock.now_ns())
        self._next_ns = int(self._state.next_truth_ns)

    def turn(self) -> None:
        """Read, update, write, keep time."""
        self._can.take_commands(self._params, self._state, self._clock.now_ns())
        self._injection.take(self._params, self._state)
        late_ns = max(self._let_happen(self._clock.now_ns()), self._send_due(self._clock.now_ns()))
        self._late_max_ns = max(self._late_max_ns, late_ns)
        self._misses += late_ns > LATE_NS
        self._status.cycle(late_ns)
        self._clock.sleep_until_ns(min(self._next_ns, self._outbox.next_ns, self._can.next_ns))

    def close(self) -> None:
        self._serial.close()
        self._can.close()
        self._status.close()

    def _let_happen(self, now_ns: int) -> int:
        """Bring the rig to `now_ns`; returns how late the first happening was noticed."""
        late_ns = self._pace.lateness_ns(self._next_ns)
        self._can.move(self._params, self._state)
        while self._state["reached_ns"] < now_ns:
            # What comes of a frame on a bus in time comes at its end: no further than to the next one.
            to_ns = max(min(now_ns, self._can.next_ns), int(self._state["reached_ns"]) + 1)
            count = run_until(self._params, self._state, to_ns, self._events)
            for kind, sample_ns, end_ns, raw, value in self._events[:count].tolist():
                self._take(kind, sample_ns, end_ns, raw.tolist(), value)
            self._can.move(self._params, self._state)
        self._next_ns = int(next_event_ns(self._params, self._state))
        return late_ns

    def _take(self, kind: int, sample_ns: int, end_ns: int, raw: list[int], value: float) -> None:
        if kind == EVENT_TRUTH:
            self._publish_truth()
            self._await_arming()
            self._serial.listen(self._params, self._state, self._outbox)
        elif kind == EVENT_LOAD:
            self._reporter.say(KIND_LOAD, sample_ns, code=raw[0], reason=raw[1], value=value)
        elif kind == EVENT_FAULT:
            self._reporter.say(KIND_FAULT, sample_ns, code=raw[0], reason=raw[1], value=value)
        elif kind == EVENT_DRIVER:
            self._reporter.say(KIND_DRIVER, sample_ns, code=raw[0])
        elif not self._can.hand_over(kind, raw, end_ns):
            self._outbox.add(end_ns, kind, raw)

    def _await_arming(self) -> None:
        """Where faults count from the gate's arming: let them begin when it is known."""
        armed_ns = self._armed_ns() if self._armed_ns is not None else None
        if armed_ns is not None:
            self._armed_ns = None
            begin_faults(self._params, self._state, self._waiting, armed_ns - int(self._state.start_ns))

    def _publish_truth(self) -> None:
        truth = self._state.truth
        truth.deadline_misses, truth.late_max_ns = self._misses, self._late_max_ns
        self._late_max_ns = 0
        self._put_truth(self._truth_type.pack_record(truth))

    def _send_due(self, now_ns: int) -> int:
        """Send what has come to its end on the wire by now; returns the worst lateness."""
        late_ns = 0
        for end_ns, kind, raw in self._outbox.take(now_ns):
            late_ns = max(late_ns, self._pace.lateness_ns(end_ns))
            if not self._can.send(kind, raw, end_ns):
                self._serial.send(kind, raw, end_ns)
        return late_ns


def run(config: PlantProcess, context: Context) -> None:
    """Be the simulated rig until asked to stop. Raises Unavailable when a wire cannot be opened, Lost when it goes away."""
    plant = Plant(config, context)
    context.enter_loop()
    plant.start()
    try:
        while not context.stop:
            plant.turn()
    finally:
        plant.close()
