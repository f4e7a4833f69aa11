"""The whole rig closed in one compiled loop: the processes' own kernels, without processes, bytes and wires.

Tick by tick it does what the processes do at lockstep pace, in the same order and with the same stamps, so that it leaves the
same bytes: plant, quantisers, adapters, controller, gate, driver. What the byte codecs do in between (cantools, WT931 packets,
CDR) changes no value; tests hold that, and `make exact` compares whole runs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from softloop.controller.command import fill_command
from softloop.controller.laws.arc import STEP1_TYPE
from softloop.controller.records import CONFIG_TYPE, CYCLE_TYPE, GAINS_TYPE, INPUTS_TYPE
from softloop.controller.records import STATE_TYPE as CONTROLLER_STATE_TYPE
from softloop.controller.tick import SCRATCH_TYPE, controller_tick
from softloop.devices.gate import DRIVER_OK, DRIVER_WATCHDOG, gate_step
from softloop.devices.gate_messages import fill_status, give_command
from softloop.devices.protocols.analog import SAMPLE
from softloop.devices.protocols.analog_kernels import analog_step
from softloop.devices.protocols.quantise_kernels import (
    counts_to_deg,
    counts_to_deg_s,
    counts_to_kpa,
    mounted_deg,
)
from softloop.devices.protocols.wt931 import NOTHING
from softloop.devices.protocols.wt931 import SAMPLE as WHOLE_SAMPLE
from softloop.devices.protocols.wt931_kernels import sample_step
from softloop.dynamics.parameters import MODEL_TYPE
from softloop.offline.loop_records import (
    BETWEEN_TYPE,
    FIFO_TYPE,
    INCLINATION_TYPE,
    LINK_TYPE,
    PRESSURE_TYPE,
    SHEET_TYPE,
    STATUS_TYPE,
    TRUTH_TYPE,
    arrived,
    drop_first,
    push,
)
from softloop.plant.electrical import accept_command, run_until
from softloop.plant.inclinometer_device import VERSION_WORD
from softloop.plant.records import (
    EVENT_ANALOG_FRAME,
    EVENT_DRIVER_FRAME,
    EVENT_INCLINOMETER,
    EVENT_TRUTH,
    EVENTS_TYPE,
    PLANT_TYPE,
)
from softloop.plant.records import STATE_TYPE as PLANT_STATE_TYPE
from softloop.wire.kernel import array_of, kernel
from softloop.wire.messages import constant
from softloop.wire.schedule import LAUNCHER_ORIGIN, PERIOD_NS

_F8, _I8, _VOID = types.f8, types.i8, types.void
_PRESSURE_OK = constant("PressureSample", "STATUS_OK")
_OUT_OF_RANGE = constant("PressureSample", "STATUS_OUT_OF_RANGE")
_RATE_OK = constant("InclinationSample", "STATUS_OK")
_RATE_MISSING = constant("InclinationSample", "STATUS_RATE_MISSING")
SHUTDOWN_FRAMES = 5  # as `devices.valves` sends them
_PRESSURES, _INCLINATIONS = array_of(PRESSURE_TYPE), array_of(INCLINATION_TYPE)
_TRUTHS, _STATUSES, _CYCLES = array_of(TRUTH_TYPE), array_of(STATUS_TYPE), array_of(CYCLE_TYPE)


@kernel(_VOID(PLANT_TYPE, PLANT_STATE_TYPE, _I8, EVENTS_TYPE, BETWEEN_TYPE, _TRUTHS))
def run_plant(params: Any, plant: Any, to_ns: int, events: np.ndarray, between: Any, truths: np.ndarray) -> None:
    """Bring the plant to `to_ns`; what it sends is under way, what it knows is in `truths`."""
    while plant.reached_ns < to_ns:
        count = run_until(params, plant, to_ns, events)
        for i in range(count):
            kind = events[i].kind
            if kind == EVENT_ANALOG_FRAME:
                push(between.analog_way, events[i])
            elif kind == EVENT_INCLINOMETER:
                push(between.serial_way, events[i])
            elif kind == EVENT_DRIVER_FRAME:
                push(between.driver_way, events[i])
            elif kind == EVENT_TRUTH:
                if between.truths < truths.size:
                    truths[between.truths] = plant.truth
                between.truths += 1


@kernel(_F8(SHEET_TYPE, _I8))
def pressure_of(sheet: Any, counts: int) -> float:
    """KPa of a sensor's counts."""
    return counts_to_kpa(counts, sheet.zero_v, sheet.full_v, sheet.span_kpa)


@kernel(_VOID(LINK_TYPE, BETWEEN_TYPE, _I8, PRESSURE_TYPE, _PRESSURES))
def take_pressures(link: Any, between: Any, now_ns: int, sample: Any, kept: np.ndarray) -> None:
    """The process `pressures`: the frames that have arrived by `now_ns`; `sample` is the last one."""
    way, state = between.analog_way, between.analog
    while arrived(way, now_ns):
        event = way.events[way.head]
        supply, chamber = pressure_of(link.supply, event.raw[0]), pressure_of(link.chamber, event.raw[1])
        stamp_ns, end_ns = event.end_ns - link.analog_frame_ns, event.end_ns
        if analog_step(link.analog, state, event.raw[2], supply, chamber, stamp_ns, end_ns) == SAMPLE:
            sample.seq, sample.stamp_ns = state.seq, state.stamp_ns
            sample.received_ns, sample.published_ns = end_ns, end_ns
            sample.supply_pressure_kpa, sample.chamber_pressure_kpa = supply, chamber
            sample.missed = state.missed
            sample.status = _PRESSURE_OK if state.in_range else _OUT_OF_RANGE
            if between.pressures < kept.size:
                kept[between.pressures] = sample
            between.pressures += 1
        drop_first(way)


@kernel(_VOID(LINK_TYPE, BETWEEN_TYPE, _I8, INCLINATION_TYPE, _INCLINATIONS))
def take_inclinations(link: Any, between: Any, now_ns: int, sample: Any, kept: np.ndarray) -> None:
    """The process `inclinometer`: the packets that have arrived by `now_ns`; `sample` is the last one."""
    way, state = between.serial_way, between.sampler
    while arrived(way, now_ns):
        event = way.events[way.head]
        stamp_ns = event.end_ns - link.sample_bytes_ns
        kind = sample_step(link.sampler, state, 1, event.raw[0], event.raw[1], VERSION_WORD, stamp_ns)
        if kind != NOTHING:
            between.inclination_seq += 1
            sample.seq, sample.stamp_ns = between.inclination_seq, stamp_ns
            sample.received_ns, sample.published_ns = event.end_ns, event.end_ns
            sample.angle_deg = mounted_deg(counts_to_deg(state.turned), link.direction, link.zero_deg)
            sample.rate_deg_s = link.direction * counts_to_deg_s(state.rate)
            sample.rejected = state.rejected
            sample.status = _RATE_OK if kind == WHOLE_SAMPLE else _RATE_MISSING
            if between.inclinations < kept.size:
                kept[between.inclinations] = sample
            between.inclinations += 1
        drop_first(way)


@kernel(_VOID(LINK_TYPE, BETWEEN_TYPE, FIFO_TYPE, _I8))
def hear_driver(link: Any, between: Any, way: Any, now_ns: int) -> None:
    """The driver's status frames that the gate has by `now_ns`."""
    while arrived(way, now_ns):
        event = way.events[way.head]
        between.given.driver = DRIVER_OK if event.raw[2] == 0 else DRIVER_WATCHDOG
        between.given.driver_stamp_ns = event.end_ns - link.driver_frame_ns
        between.frame.charge_coil, between.frame.exhaust_coil = event.raw[0], event.raw[1]
        drop_first(way)


@kernel(_VOID(LINK_TYPE, BETWEEN_TYPE, _I8))
def hear_requests(link: Any, between: Any, now_ns: int) -> None:
    """The launcher's two requests, each when it is due."""
    given = between.given
    given.stop, given.disarm, given.arm = 0, 0, 0
    if between.requests == 0 and link.arm_ns <= now_ns:
        given.arm, given.arm_origin, given.arm_seq, given.arm_stamp_ns = 1, LAUNCHER_ORIGIN, 1, now_ns
        between.requests = 1
    if between.requests == 1 and link.disarm_ns <= now_ns:
        given.disarm = 1
        between.requests = 2


@kernel(_VOID(LINK_TYPE, BETWEEN_TYPE, _I8, STATUS_TYPE))
def run_gate(link: Any, between: Any, now_ns: int, status: Any) -> None:
    """The process `valves`, one step: requests, judgement, and its word on the frame."""
    hear_requests(link, between, now_ns)
    between.given.now_ns = now_ns
    gate_step(link.gate, between.gate, between.given, between.output)
    between.frame.seq += 1
    between.frame.stamp_ns, between.frame.tick = now_ns, between.command.tick
    fill_status(between.frame, between.given, between.gate, between.output, status)


@kernel(_VOID(LINK_TYPE, BETWEEN_TYPE, _I8, STATUS_TYPE, _STATUSES))
def shut_gate(link: Any, between: Any, now_ns: int, status: Any, statuses: np.ndarray) -> None:
    """What `valves` does when it ends: disarm, and a few frames more."""
    between.given.shutdown = 1
    for k in range(SHUTDOWN_FRAMES):
        between.given.command_new = 0
        run_gate(link, between, now_ns + k * PERIOD_NS, status)
        if between.frame.seq <= statuses.size:
            statuses[between.frame.seq - 1] = status


@kernel(
    _VOID(
        CONFIG_TYPE, MODEL_TYPE, GAINS_TYPE, array_of(_F8), array_of(_F8, 2), INPUTS_TYPE, CONTROLLER_STATE_TYPE, SCRATCH_TYPE,
        STEP1_TYPE, PLANT_TYPE, PLANT_STATE_TYPE, EVENTS_TYPE, LINK_TYPE, BETWEEN_TYPE, _CYCLES, _TRUTHS, _STATUSES, _PRESSURES,
        _INCLINATIONS,
    )
)  # fmt: skip
def simulate(
    config: Any, model: Any, gains: Any, knots: np.ndarray, table: np.ndarray, inputs: Any, state: Any, scratch: Any, first: Any,
    params: Any, plant: Any, events: np.ndarray, link: Any, between: Any, cycles: np.ndarray, truths: np.ndarray,
    statuses: np.ndarray, pressures: np.ndarray, inclinations: np.ndarray,
) -> None:  # fmt: skip
    """Run one tick per place of `cycles`, from rest; all arrays are filled, those of length 0 left.

    Tick 0 is the start, on which the controller does not run: place k of `cycles` is tick k + 1.
    """
    start_ns = plant.reached_ns
    for k in range(cycles.size):
        now_ns = start_ns + (k + 1) * PERIOD_NS
        run_plant(params, plant, now_ns, events, between, truths)
        take_pressures(link, between, now_ns, inputs.pressure, pressures)
        take_inclinations(link, between, now_ns, inputs.inclination, inclinations)
        hear_driver(link, between, between.driver_way, now_ns)
        inputs.now_ns, inputs.tick = now_ns, k
        cycle = cycles[k]
        controller_tick(config, model, gains, knots, table, inputs, state, scratch, first, cycle)
        cycle.woken_ns, cycle.computed_ns, cycle.published_ns = now_ns, now_ns, now_ns
        sent_ns = now_ns + link.latency_ns
        fill_command(cycle, between.command)
        give_command(between.given, between.command, sent_ns)
        run_gate(link, between, sent_ns, inputs.valves)
        if k < statuses.size:
            statuses[k] = inputs.valves
        output, end_ns = between.output, sent_ns + link.valve_frame_ns
        accept_command(
            params, plant, end_ns, output.charge_counts, output.exhaust_counts, output.output, between.frame.seq & 0xFFFF
        )
    shut_gate(link, between, start_ns + cycles.size * PERIOD_NS + link.latency_ns, inputs.valves, statuses)
