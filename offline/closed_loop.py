"""Runs in this process: from the tables of a bench file to the records of the closed loop, and what a run leaves."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softloop.controller.config import ControllerConfig
from softloop.controller.records import CYCLE, PHASE_APPROACH, PHASE_DONE, PHASE_TRACK
from softloop.controller.setup import Controller, build
from softloop.devices.config import (
    ANALOG_DLC,
    InclinometerConfig,
    PressuresConfig,
    SensorConfig,
    ValvesConfig,
    analog_config,
    pressures_process,
    sampler_bounds,
    valves_process,
)
from softloop.devices.gate import GATE_FAULT, gate_config
from softloop.devices.protocols.analog import ANALOG_CONFIG, AnalogConfig
from softloop.devices.protocols.wire_time import can_frame_ns, serial_ns
from softloop.devices.protocols.wt931 import SAMPLE_BYTES, SAMPLER_CONFIG, as_record
from softloop.offline.loop_kernels import SHUTDOWN_FRAMES, simulate
from softloop.offline.loop_records import BETWEEN, INCLINATION, LINK, PRESSURE, TRUTH, VALVE_STATUS, no_records
from softloop.plant.config import PlantConfig
from softloop.plant.records import EVENT
from softloop.plant.setup import WireTimes, new_device, new_state, plant_record
from softloop.wire.can_config import CanConfig
from softloop.wire.config import PaceConfig
from softloop.wire.errors import BadConfig
from softloop.wire.kernel import new_record
from softloop.wire.messages import names_of
from softloop.wire.schedule import PERIOD_NS, START_NS, Schedule, make_schedule

Records = NDArray[Any]
_REASONS = names_of("ValveStatus", "REASON_")
_EVENTS = 64
SETTLE_S, VENT_S = 0.5, 0.0


@dataclass(frozen=True)
class RigTables:
    """The tables of a bench file that a run without processes needs; see each table's model."""

    controller: ControllerConfig
    plant: PlantConfig
    valves: ValvesConfig = field(default_factory=ValvesConfig)
    pressures: PressuresConfig = field(default_factory=PressuresConfig)
    inclinometer: InclinometerConfig = field(default_factory=lambda: InclinometerConfig(port="none"))
    can: dict[str, CanConfig] = field(default_factory=lambda: {"can0": CanConfig()})
    pace: PaceConfig = field(default_factory=PaceConfig)


@dataclass
class Trace:
    """All that a run leaves, in the messages' own records; see `loop_kernels.simulate`."""

    cycles: Records
    truths: Records
    statuses: Records
    pressures: Records
    inclinations: Records


@dataclass
class Run:
    """A simulated run from its first armed tick to the end of its trajectory: a `CycleRecord` and a `PlantTruth` per tick.

    Attributes:
        fault: why the gate went to FAULT; empty when it did not. A run with a fault did not follow its trajectory.
        completed: it followed the trajectory to its end.
    """

    cycles: Records
    truths: Records
    fault: str = ""
    completed: bool = True


def simulate_run(controller: ControllerConfig, plant: PlantConfig, *, valves: ValvesConfig | None = None) -> Run:
    """One whole run, approach and trajectory, in this process, with the delays of `[plant]` declared to the gate.

    Raises BadFile or BadConfig.
    """
    return simulate_tables(RigTables(controller, plant, valves or declared(ValvesConfig(), plant)))


def declared(valves: ValvesConfig, plant: PlantConfig) -> ValvesConfig:
    """`valves` with the delays that `[plant]` adds declared in its path delay, as a bench with such wires has to."""
    added_ms = plant.measurement_delay_ms
    return valves.model_copy(update={"path_delay_ms": valves.path_delay_ms + added_ms})


def simulate_tables(tables: RigTables) -> Run:
    """One whole run of a rig. Raises BadFile or BadConfig."""
    built = ready_controller(tables.controller)
    approach_ns = int(built.config[0].approach_ns)
    schedule = make_schedule(SETTLE_S, 1e-9 * (approach_ns + built.plan.duration_ns) + 0.1, VENT_S)
    trace = simulate_trace(tables, schedule, built, all_channels=False)
    return _whole_run(trace, (approach_ns + built.plan.duration_ns) // PERIOD_NS, schedule)


def _whole_run(trace: Trace, ticks: int, schedule: Schedule) -> Run:
    phases = trace.cycles["phase"]
    active = np.flatnonzero((phases == PHASE_APPROACH) | (phases == PHASE_TRACK))
    first = int(active[0]) if active.size else (schedule.arm_ns - START_NS) // PERIOD_NS
    part = slice(first, first + ticks)
    last = trace.statuses[-1]
    fault = _REASONS.get(int(last["reason"]), "unknown") if last["gate"] == GATE_FAULT else ""
    return Run(trace.cycles[part], trace.truths[1:][part], fault, bool((phases == PHASE_DONE).any()))


@lru_cache(maxsize=64)
def _built(config: ControllerConfig) -> Controller:
    return build(config)


def ready_controller(config: ControllerConfig) -> Controller:
    """A controller that has not ticked yet; what follows from its config alone is made once."""
    made = _built(config)
    return Controller(
        made.config, made.model, made.gains, made.plan, np.zeros_like(made.inputs), made.state.copy(), np.zeros_like(made.cycle),
        np.zeros_like(made.scratch), np.zeros_like(made.first),
    )  # fmt: skip


def simulate_trace(tables: RigTables, schedule: Schedule, built: Controller | None = None, *, all_channels: bool = True) -> Trace:
    """A run tick by tick as the processes do it at lockstep pace; without `all_channels` samples are not kept, and one status is.

    Raises BadFile or BadConfig.
    """
    built = ready_controller(tables.controller) if built is None else built
    plant = tables.plant
    buses = tables.can
    params = plant_record(plant, WireTimes(buses[plant.can_valves].bitrate, buses[plant.can_analog].bitrate))
    state = new_state(params, new_device(plant), START_NS)
    link, between = link_record(tables, params, schedule), new_record(BETWEEN)
    between.analog.counter = -1
    ticks = schedule.ticks - 1
    cycles, truths = np.zeros(ticks, CYCLE), np.zeros(schedule.ticks, TRUTH)
    kept = 2 * schedule.ticks if all_channels else 0
    statuses = np.zeros(ticks + SHUTDOWN_FRAMES, VALVE_STATUS) if all_channels else no_records(VALVE_STATUS)
    pressures, inclinations = np.zeros(kept, PRESSURE), np.zeros(kept, INCLINATION)
    simulate(
        built.config[0], built.model[0], built.gains[0], built.plan.knots, built.plan.table, built.inputs[0], built.state[0],
        built.scratch[0], built.first[0], params, state, np.zeros(_EVENTS, EVENT), link, between, cycles, truths, statuses,
        pressures, inclinations,
    )  # fmt: skip
    if not all_channels:
        statuses = built.inputs["valves"].copy()
    return Trace(cycles, truths, statuses, pressures[: between.pressures], inclinations[: between.inclinations])


def link_record(tables: RigTables, params: Any, schedule: Schedule) -> Any:
    """The `LINK` record: what the adapters and the gate know of each other and of their wires."""
    bus = tables.can[tables.plant.can_valves]
    if bus.emulation is not None or tables.can[tables.plant.can_analog].emulation is not None:
        raise BadConfig(
            "key 'can': a run in one process has no bus to emulate; leave out [can.NAME.emulation], or run its processes"
        )
    link, inclinometer = new_record(LINK), tables.inclinometer
    link.latency_ns = 1000 * tables.pace.software_latency_us
    link.driver_frame_ns, link.analog_frame_ns = params.electrical.driver_frame_ns, params.electrical.analog_frame_ns
    link.valve_frame_ns = can_frame_ns(ANALOG_DLC, bus.bitrate)
    link.sample_bytes_ns = serial_ns(SAMPLE_BYTES, inclinometer.baud)
    link.arm_ns, link.disarm_ns = schedule.arm_ns, schedule.disarm_ns
    link.direction, link.zero_deg = inclinometer.direction, inclinometer.zero_deg
    _fill_sheet(link.supply, tables.pressures.supply)
    _fill_sheet(link.chamber, tables.pressures.chamber)
    link.analog = _analog_record(analog_config(pressures_process(tables.pressures, tables.can)))
    link.sampler = as_record(sampler_bounds(inclinometer), SAMPLER_CONFIG)
    link.gate = gate_config(valves_process(tables.valves, tables.pressures, inclinometer, tables.can))
    return link


def _fill_sheet(record: Any, sensor: SensorConfig) -> None:
    record.zero_v, record.full_v, record.span_kpa = sensor.zero_v, sensor.full_v, sensor.span_kpa


def _analog_record(config: AnalogConfig) -> Any:
    record = new_record(ANALOG_CONFIG)
    for name in ANALOG_CONFIG.names or ():
        record[name] = getattr(config, name)
    return record
