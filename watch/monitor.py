"""The monitor: judges every cycle record of a running rig, says which invariant does not hold, and can fault the gate.

It listens, as the recorder does: nothing waits for it. What it finds is an event, once while it lasts; with `faults_gate` it
asks the gate for FAULT until the gate is not armed any more.
"""

from __future__ import annotations

import secrets
from math import inf
from pathlib import Path
from typing import Any

from softloop.dynamics.parameter_file import Parameters, in_theta_order, load_parameters, shipped
from softloop.watch.config import MonitorProcess
from softloop.watch.invariants import PERIOD_S, Limits, Memory, Verdict, judge, settling_ticks, ultimate_v2
from softloop.wire.channels import CYCLE, REQUEST, VALVES
from softloop.wire.messages import BadPayload, constant, message, names_of
from softloop.wire.shell import Context, say
from softloop.wire.status import EventReporter, StatusReporter

NAME = "monitor"
_SOURCE, _KIND = constant("Event", "SOURCE_MONITOR"), constant("Event", "KIND_INVARIANT")
_NAMES = names_of("Event", "INVARIANT_")
_ARMED = constant("ValveStatus", "GATE_ARMED")
_FAULT = constant("GateRequest", "ACTION_FAULT")
_AGAIN_NS = 100_000_000  # nothing on the wires waits: a request is made again until the gate has obeyed


def parameters_of(process: MonitorProcess) -> Parameters:
    """The controller's parameter file. Raises BadFile or BadConfig when it cannot be read."""
    named = shipped(process.parameters)
    return load_parameters(named if named.is_file() else Path(process.parameters))


def limits_of(process: MonitorProcess, parameters: Parameters) -> Limits:
    """The limits of a bench whose controller runs on `parameters`."""
    table, law = process.table, process.law
    bound = {"v2_max": inf}
    if law is not None and table.bound:
        v2, decay = ultimate_v2(law.k1, law.k2, law.epsilon1 + law.rho * law.epsilon2)
        bound = {"v2_max": table.bound_margin * v2, "rho": law.rho, "desired_max_kpa": law.desired_max_kpa}
        bound["settled_ticks"] = settling_ticks(decay)
    return Limits(
        theta=tuple((low, high) for _, low, high in in_theta_order(parameters)),
        watch_theta=table.parameters,
        current_max_ma=parameters.pneumatics.current_max_ma if table.command else inf,
        error_max_deg=table.error_max_deg if table.error and process.angle else inf,
        error_ticks=max(1, round(table.error_s / PERIOD_S)),
        switches_max=table.switches_per_s if table.chatter else inf,
        **bound,  # type: ignore[arg-type]
    )


class Monitor:
    """The process's state: what is known, and what was said."""

    def __init__(self, process: MonitorProcess, context: Context) -> None:
        self.context, self.clock = context, context.clock
        self.limits, self.memory = limits_of(process, parameters_of(process)), Memory()
        self.faults_gate, self.poll_s = process.table.faults_gate, process.table.poll_s
        self.broken: set[int] = set()
        self.armed, self.requests, self.asked_ns = False, 0, -_AGAIN_NS
        self._origin = secrets.randbits(63) or 1
        self._cycles, self._valves = context.wire.inbox(CYCLE), context.wire.latest(VALVES)
        self._put = context.wire.publisher(REQUEST)
        self._status, self._events = StatusReporter(context, _SOURCE), EventReporter(context, _SOURCE)

    def step(self) -> None:
        """Take what came, judge it, and ask for FAULT where that is wanted."""
        for _, payload in self._cycles.take_all():
            try:
                cycle = message("CycleRecord").unpack(payload)
            except BadPayload:
                self._status.dropped += 1
                continue
            self.memory, found = judge(self.limits, self.memory, cycle)
            self._tell(found, cycle)
        self._look_at_gate()
        if self.broken and self.faults_gate and self.armed:
            self._ask_for_fault()
        self._status.cycle()

    def _tell(self, found: tuple[Verdict, ...], cycle: Any) -> None:
        for verdict in found:
            if verdict.invariant not in self.broken:
                at = {"stamp_ns": int(cycle.stamp_ns), "tick": int(cycle.tick)}
                self._events.say(_KIND, code=verdict.invariant, value=verdict.value, **at)
                say(NAME, f"the invariant '{_NAMES[verdict.invariant]}' does not hold at tick {cycle.tick}: {verdict.value:.4g}")
        # With `faults_gate` what was found stays until the gate has obeyed; otherwise it can be found again.
        self.broken = {v.invariant for v in found} | (self.broken if self.faults_gate else set())

    def _look_at_gate(self) -> None:
        payload = self._valves.take()
        if payload is None:
            return
        try:
            self.armed = message("ValveStatus").unpack(payload).gate == _ARMED
        except BadPayload:
            self._status.dropped += 1
        if not self.armed:
            self.broken = set()

    def _ask_for_fault(self) -> None:
        now_ns = self.clock.now_ns()
        if now_ns - self.asked_ns < _AGAIN_NS:
            return
        self.asked_ns = now_ns
        self.requests += 1
        request = message("GateRequest")
        self._put(request.pack(request.make(seq=self.requests, stamp_ns=now_ns, origin=self._origin, action=_FAULT)))

    def close(self) -> None:
        """The last word."""
        self._status.close()


def run(process: MonitorProcess, context: Context) -> None:
    """The monitor process. Raises BadFile or BadConfig before its loop."""
    monitor = Monitor(process, context)
    context.enter_loop()
    while not context.stop:
        monitor.step()
        context.stop.wait(monitor.poll_s)
    monitor.close()
