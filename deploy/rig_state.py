"""What the launcher knows of a running rig: the newest sample of each channel it watches, and what happened."""

from __future__ import annotations

import time
from typing import Any

from softloop.deploy.node import PROCESSES
from softloop.wire.backlog import Backlog
from softloop.wire.channels import CYCLE, EVENT, PRESSURE, STATUS, VALVES, key
from softloop.wire.messages import BadPayload, constant, message, names_of
from softloop.wire.session import Wire

GATE_DISARMED = constant("ValveStatus", "GATE_DISARMED")
GATE_ARMED = constant("ValveStatus", "GATE_ARMED")
GATE_FAULT = constant("ValveStatus", "GATE_FAULT")
OUTPUT_CLOSED = constant("ValveStatus", "OUTPUT_CLOSED")
PHASE_TRACK = constant("CycleRecord", "PHASE_TRACK")
PHASE_DONE = constant("CycleRecord", "PHASE_DONE")
GATES = names_of("ValveStatus", "GATE_")
OUTPUTS = names_of("ValveStatus", "OUTPUT_")
REASONS = names_of("ValveStatus", "REASON_")
DRIVERS = names_of("ValveStatus", "DRIVER_")
PHASES = names_of("CycleRecord", "PHASE_")
LOADS = {1: "payload", 2: "contact"}
INVARIANTS = names_of("Event", "INVARIANT_")
CLOCKS, CLOCK_DRIFT = names_of("Event", "CLOCK_"), constant("Event", "CLOCK_DRIFT")
FAULTS = names_of("Event", "FAULT_")
_KINDS = names_of("Event", "KIND_")
_BACKLOG = 4096
_SOURCE_NAMES = {constant("Event", p.source): p.name for p in PROCESSES}


class RigState:
    """The newest of each watched channel. `refresh` takes what came; the fields are messages or None."""

    def __init__(self, wire: Wire) -> None:
        self._cycles = wire.latest(CYCLE)
        self._valves = wire.latest(VALVES)
        self._pressures = wire.latest(PRESSURE)
        # Not by callbacks: where the launcher is the meeting point, Zenoh's threads must not wait for its Python.
        self._statuses, self._events = (Backlog(wire.session, key(wire.bench, c), _BACKLOG) for c in (STATUS, EVENT))
        self.cycle: Any = None
        self.valves: Any = None
        self.pressure: Any = None
        self.statuses: dict[str, Any] = {}
        self.valves_heard_ns = 0
        self.was_armed = False

    def refresh(self) -> list[str]:
        """Take what came since the last call; returns one line for each event in it."""
        self.cycle = _newest(self._cycles.take(), "CycleRecord", self.cycle)
        self.pressure = _newest(self._pressures.take(), "PressureSample", self.pressure)
        payload = self._valves.take()
        if payload is not None:
            self.valves_heard_ns = time.monotonic_ns()
            self.valves = _newest(payload, "ValveStatus", self.valves)
            self.was_armed |= self.valves is not None and self.valves.gate != GATE_DISARMED
        for _, payload in self._statuses.take_all()[0]:
            status = _newest(payload, "ProcessStatus", None)
            if status is not None and status.process in _SOURCE_NAMES:
                self.statuses[_SOURCE_NAMES[status.process]] = status
        events = (_newest(payload, "Event", None) for _, payload in self._events.take_all()[0])
        return [self.event_line(event) for event in events if event is not None]

    @property
    def gate(self) -> int | None:
        """The gate's state, None before its first word."""
        return None if self.valves is None else self.valves.gate

    @property
    def gate_stamp_ns(self) -> int:
        """Of the gate's newest word, rig clock; 0 before its first one."""
        return 0 if self.valves is None else int(self.valves.stamp_ns)

    @property
    def armed(self) -> bool:
        return self.gate == GATE_ARMED

    @property
    def reason(self) -> str:
        """The gate's reason in words."""
        return "unknown" if self.valves is None else reason_text(self.valves.reason)

    @property
    def done(self) -> bool:
        """The controller says that its trajectory is over."""
        return self.cycle is not None and self.cycle.phase == PHASE_DONE

    @property
    def trajectory_s(self) -> float:
        """Time on the trajectory, 0 before it begins."""
        tracking = self.cycle is not None and self.cycle.phase in (PHASE_TRACK, PHASE_DONE)
        return max(0, self.cycle.trajectory_ns) * 1e-9 if tracking else 0.0

    def vented(self, vented_kpa: float) -> bool:
        """The gate says that venting is over; where no gate speaks, the chamber's pressure is gone."""
        if self.valves is not None:
            return bool(self.valves.gate != GATE_ARMED and self.valves.output == OUTPUT_CLOSED)
        return self.pressure is not None and self.pressure.chamber_pressure_kpa < vented_kpa

    def event_line(self, event: Any) -> str:
        """An event in words, such as `valves: gate fault (sensor stale)`."""
        return event_line(event)


def event_line(event: Any) -> str:
    """An event in words, such as `valves: gate fault (sensor stale)`."""
    return f"{_SOURCE_NAMES.get(event.source, 'launcher')}: {_event_text(event)}"


def reason_text(reason: int) -> str:
    """A gate's reason in words: 3 -> `not finite`."""
    return REASONS.get(reason, f"reason {reason}").replace("_", " ")


def _event_text(event: Any) -> str:
    kind = _KINDS.get(event.kind, f"event {event.kind}")
    if kind == "gate":
        why = f" ({reason_text(event.reason)})" if event.reason else ""
        return f"gate {GATES.get(event.code, event.code)}{why}"
    if kind == "phase":
        return f"phase {PHASES.get(event.code, event.code)}"
    if kind == "load":
        return f"{LOADS.get(event.reason, 'load')} {'came' if event.code else 'left'} ({event.value:g})"
    if kind == "fault":
        return f"fault {FAULTS.get(event.reason, event.reason)} {'came' if event.code else 'left'} ({event.value:g})"
    if kind == "invariant":
        return f"invariant '{INVARIANTS.get(event.code, event.code)}' does not hold ({event.value:.4g})"
    if kind == "process":
        name = _SOURCE_NAMES.get(event.reason, "a viewer")
        return f"{name} is back after {event.value:.1f} s" if event.code else f"{name} was lost"
    if kind == "clock":
        unit = "ppm" if event.code == CLOCK_DRIFT else "ms"
        return f"clock of host {event.reason}: {CLOCKS.get(event.code, event.code)} ({event.value:.4g} {unit})"
    if kind == "router":
        return f"the meeting point is back after {event.value:.1f} s" if event.code else "the meeting point was lost"
    if kind == "host":
        again = f"is heard again after {event.value:.1f} s"
        return f"host {event.reason} {again if event.code else 'is not heard'}"
    if kind == "driver":
        return f"valve driver {DRIVERS.get(event.code, event.code)}"
    if kind == "bus":
        return f"bus {'lost' if event.code else 'back'}"
    return f"{kind}: {event.value:g}"


def _newest(payload: bytes | None, name: str, before: Any) -> Any:
    if payload is None:
        return before
    try:
        return message(name).unpack(payload)
    except BadPayload:
        return before
