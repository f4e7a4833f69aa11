"""Plant and controller closed in one compiled loop: the processes' own kernels, without processes and wires.

Samples arrive when their frame or packets end; a command takes effect at its frame's end, `loop_delay_ns` (the software's
share, from tick to bus) and the frame's time after its tick. The gate is taken as armed from the first tick on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from softloop.controller.config import ControllerConfig
from softloop.controller.laws.arc import STEP1_TYPE
from softloop.controller.records import CONFIG_TYPE, CYCLE, CYCLE_TYPE, GAINS_TYPE, GATE_ARMED, INPUTS_TYPE, OUTPUT_PASS
from softloop.controller.records import STATE_TYPE as CONTROLLER_STATE_TYPE
from softloop.controller.setup import PERIOD_NS, build
from softloop.controller.tick import SCRATCH_TYPE, controller_tick
from softloop.devices.protocols.quantise_kernels import counts_to_deg, counts_to_deg_s, counts_to_kpa, current_to_counts
from softloop.dynamics.parameters import MODEL_TYPE
from softloop.plant.config import PlantConfig
from softloop.plant.electrical import accept_command, run_until
from softloop.plant.records import EVENT, EVENT_ANALOG_FRAME, EVENT_INCLINOMETER, EVENT_TRUTH, EVENTS_TYPE, PLANT_TYPE
from softloop.plant.records import STATE_TYPE as PLANT_STATE_TYPE
from softloop.plant.setup import new_device, new_state, plant_record
from softloop.wire.kernel import array_of, kernel, new_record, record_dtype, record_type
from softloop.wire.messages import message

_F8, _I8 = types.f8, types.i8
TRUTH = message("PlantTruth").dtype
SETTLE_TICKS = 40  # before the first tick: the sensors' first samples arrive
_PENDING = 128  # samples under way; at 200 Hz enough for 600 ms of added delay

WIRING = record_dtype([("loop_delay_ns", "i8"), ("frame_ns", "i8"), ("zero_v", "f8"), ("full_v", "f8"), ("span_kpa", "f8")])
WIRING_TYPE = record_type(WIRING)
PENDING = record_dtype([("events", EVENT, (_PENDING,)), ("head", "i8"), ("count", "i8")])
PENDING_TYPE = record_type(PENDING)


@kernel(types.void(PENDING_TYPE, record_type(EVENT)))
def push(pending: Any, event: Any) -> None:
    """Put a sample that is under way behind the others; when full, the newest is lost."""
    if pending.count < _PENDING:
        pending.events[(pending.head + pending.count) % _PENDING] = event
        pending.count += 1


@kernel(types.void(PLANT_TYPE, PLANT_STATE_TYPE, _I8, EVENTS_TYPE, PENDING_TYPE))
def run_plant(params: Any, plant: Any, to_ns: int, events: np.ndarray, pending: Any) -> None:
    """Bring the plant to `to_ns`; its samples go to `pending`."""
    while True:
        count = run_until(params, plant, to_ns, events)
        for i in range(count):
            if events[i].kind == EVENT_ANALOG_FRAME or events[i].kind == EVENT_INCLINOMETER:
                push(pending, events[i])
        if plant.reached_ns >= to_ns and not (count > 0 and events[count - 1].kind == EVENT_TRUTH):
            return


@kernel(types.void(PENDING_TYPE, _I8, WIRING_TYPE, INPUTS_TYPE))
def deliver(pending: Any, now_ns: int, wiring: Any, inputs: Any) -> None:
    """Hand over every sample that has arrived by `now_ns`; the newest of each device is what the controller sees."""
    for _ in range(pending.count):
        event = pending.events[pending.head]
        if event.end_ns > now_ns:
            pending.head = (pending.head + 1) % _PENDING  # look at all once: the two devices' arrivals may cross
            pending.events[(pending.head + pending.count - 1) % _PENDING] = event
            continue
        pending.head = (pending.head + 1) % _PENDING
        pending.count -= 1
        if event.kind == EVENT_ANALOG_FRAME:
            inputs.pressure.seq += 1
            inputs.pressure.stamp_ns = event.sample_ns
            inputs.pressure.supply_pressure_kpa = counts_to_kpa(event.raw[0], wiring.zero_v, wiring.full_v, wiring.span_kpa)
            inputs.pressure.chamber_pressure_kpa = counts_to_kpa(event.raw[1], wiring.zero_v, wiring.full_v, wiring.span_kpa)
        else:
            inputs.inclination.seq += 1
            inputs.inclination.stamp_ns = event.sample_ns
            inputs.inclination.rate_deg_s = counts_to_deg_s(event.raw[0])
            inputs.inclination.angle_deg = counts_to_deg(event.raw[1])


@kernel(
    types.void(
        CONFIG_TYPE, MODEL_TYPE, GAINS_TYPE, array_of(_F8), array_of(_F8, 2), INPUTS_TYPE, CONTROLLER_STATE_TYPE, SCRATCH_TYPE,
        STEP1_TYPE, PLANT_TYPE, PLANT_STATE_TYPE, EVENTS_TYPE, PENDING_TYPE, WIRING_TYPE, array_of(CYCLE_TYPE),
        array_of(record_type(TRUTH)),
    )
)  # fmt: skip
def simulate(
    config: Any, model: Any, gains: Any, knots: np.ndarray, table: np.ndarray, inputs: Any, state: Any, scratch: Any, first: Any,
    params: Any, plant: Any, events: np.ndarray, pending: Any, wiring: Any, cycles: np.ndarray, truths: np.ndarray,
) -> None:  # fmt: skip
    """Run one tick per place of `cycles`; `cycles` and `truths` are filled."""
    start_ns = plant.reached_ns + SETTLE_TICKS * config.period_ns
    inputs.valves.gate, inputs.valves.output, inputs.valves.seq = GATE_ARMED, OUTPUT_PASS, 1
    for k in range(cycles.size):
        now_ns = start_ns + k * config.period_ns
        run_plant(params, plant, now_ns, events, pending)
        deliver(pending, now_ns, wiring, inputs)
        inputs.now_ns, inputs.tick = now_ns, k
        controller_tick(config, model, gains, knots, table, inputs, state, scratch, first, cycles[k])
        truths[k] = plant.truth
        charge, exhaust = current_to_counts(state.charge_ma), current_to_counts(state.exhaust_ma)
        end_ns = now_ns + wiring.loop_delay_ns + wiring.frame_ns
        accept_command(params, plant, end_ns, charge, exhaust, OUTPUT_PASS, k % 65536)


@dataclass
class Run:
    """What a simulated run leaves: one `CycleRecord` and one `PlantTruth` per tick."""

    cycles: NDArray[Any]
    truths: NDArray[Any]


def simulate_run(controller: ControllerConfig, plant: PlantConfig, loop_delay_ns: int = 600_000) -> Run:
    """One whole run, approach and trajectory, in this process. Raises BadFile or BadConfig."""
    built = build(controller)
    params = plant_record(plant)
    state = new_state(params, new_device(plant), 1_000_000_000)
    config, pending = built.config[0], new_record(PENDING)
    ticks = (int(config.approach_ns) + built.plan.duration_ns) // PERIOD_NS
    cycles, truths = np.zeros(ticks, CYCLE), np.zeros(ticks, TRUTH)
    simulate(
        config, built.model[0], built.gains[0], built.plan.knots, built.plan.table, built.inputs[0], built.state[0],
        built.scratch[0], built.first[0], params, state, np.zeros(64, EVENT), pending, _wiring(plant, params, loop_delay_ns),
        cycles, truths,
    )  # fmt: skip
    return Run(cycles, truths)


def _wiring(plant: PlantConfig, params: Any, loop_delay_ns: int) -> Any:
    wiring = new_record(WIRING)
    sensor = plant.chamber_sensor
    wiring.loop_delay_ns, wiring.frame_ns = loop_delay_ns, params.electrical.driver_frame_ns
    wiring.zero_v, wiring.full_v, wiring.span_kpa = sensor.zero_v, sensor.full_v, sensor.span_kpa
    return wiring
