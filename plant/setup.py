"""From the bench file's `[plant]` to the records that the kernels run on. Used by the process and by the one-process batch."""

from __future__ import annotations

from dataclasses import dataclass
from math import log
from pathlib import Path
from typing import Any

from softloop.devices.protocols.wire_time import can_frame_ns
from softloop.dynamics.parameters import Parameters, load_parameters, shipped
from softloop.plant.config import LoadConfig, PlantConfig, SensorConfig
from softloop.plant.electrical import DRIVER_WATCHDOG, NEVER_NS, inclinometer_period_ns
from softloop.plant.faults import FAULTS, plan_faults
from softloop.plant.inclinometer_device import InclinometerDevice
from softloop.plant.loads import plan_loads
from softloop.plant.mismatch import Draws, draw
from softloop.plant.parameters import draw_rig, fit_tank
from softloop.plant.physics import settle_inputs
from softloop.plant.records import (
    ANGLE,
    AREA_OUT,
    CREEP_0,
    GAS_K,
    LOAD_CONTACT,
    LOAD_PAYLOAD,
    N_CREEP,
    STATE,
    SUPPLY,
)
from softloop.wire.kernel import new_record

PERIOD_NS = 5_000_000
DLC = 8
DUMP_VALVE_M2 = 2e-6  # a small 2/2 valve, about three times the exhaust valve's opening
_MS = 1_000_000
_S = 1_000_000_000
_RISE_PER_LAG = log(9.0)  # 10 to 90 % of a first-order lag


@dataclass(frozen=True)
class WireTimes:
    """Bit rates of the buses the rig's frames travel on."""

    valves_bitrate: int = 500_000
    analog_bitrate: int = 500_000


def plant_parameters(config: PlantConfig) -> Parameters:
    """The parameter file that `[plant]` names. Raises BadFile or BadConfig."""
    path = Path(config.parameters)
    return load_parameters(path if path.suffix else shipped(config.parameters))


def plant_record(config: PlantConfig, wires: WireTimes | None = None) -> Any:
    """The `PLANT` record of a `[plant]` table. Raises BadFile or BadConfig when its parameter file is not usable."""
    parameters, wires = plant_parameters(config), wires or WireTimes()
    plant = draw_rig(config.layer, config.seed, parameters, config.ambient_c)
    if config.supply_kpa is not None:
        plant.air.supply_kpa = config.supply_kpa
    if config.tank_ml:
        fit_tank(plant, 1e-6 * config.tank_ml)
    drawn = draw(config.seed) if config.layer == "rig" else Draws(phases=draw(config.seed).phases)
    plant.step_ns = config.step_us * 1000
    electrical = plant.electrical
    _fill_sensors(electrical, config, drawn)
    _fill_timing(electrical, config, wires, drawn)
    electrical.vent_ma = config.vent_current_ma
    electrical.current_max_ma = parameters.pneumatics.current_max_ma
    for place, load in zip(plant.loads, config.loads, strict=False):
        _fill_load(place, load)
    for place, fault in zip(plant.faults, config.faults, strict=False):
        place.kind, place.magnitude = FAULTS[fault.kind], fault.size
        place.on_ns, place.off_ns = round(fault.on_s * _S), round(fault.off_s * _S)
    plant.dump_m2 = DUMP_VALVE_M2 if config.dump_valve else 0.0
    return plant


def _fill_sensors(electrical: Any, config: PlantConfig, drawn: Draws) -> None:
    _fill_sensor(electrical.supply, config.supply_sensor, drawn.supply_sensor, config.pressure_noise_kpa)
    _fill_sensor(electrical.chamber, config.chamber_sensor, drawn.chamber_sensor, config.pressure_noise_kpa)
    lags = config.layer == "rig"
    electrical.pressure_lag_s = config.pressure_rise_ms * 1e-3 / _RISE_PER_LAG if lags else 0.0
    electrical.inclinometer_lags = lags
    electrical.gyro_bias_deg_s, electrical.gyro_scale = drawn.gyro_bias_deg_s, drawn.gyro_scale
    electrical.angle_noise_deg, electrical.rate_noise_deg_s = config.angle_noise_deg, config.rate_noise_deg_s
    electrical.coil_noise_ma = config.coil_noise_ma
    electrical.clock_error = drawn.clock_error


def _fill_sensor(sensor: Any, sheet: SensorConfig, errors: tuple[float, float], noise_kpa: float) -> None:
    span_v = sheet.full_v - sheet.zero_v
    sensor.gain = span_v / sheet.span_kpa * (1.0 + errors[0])
    sensor.zero_v = sheet.zero_v + span_v * errors[1]
    sensor.noise_v = span_v / sheet.span_kpa * noise_kpa


def _fill_timing(electrical: Any, config: PlantConfig, wires: WireTimes, drawn: Draws) -> None:
    electrical.watchdog_ns = round(config.watchdog_ms * _MS)
    electrical.echo_period_ns = electrical.analog_period_ns = electrical.truth_period_ns = PERIOD_NS
    electrical.echo_phase_ns, electrical.analog_phase_ns, electrical.inclinometer_phase_ns = (
        int(PERIOD_NS * phase) for phase in drawn.phases
    )
    electrical.driver_frame_ns = can_frame_ns(DLC, wires.valves_bitrate)
    electrical.analog_frame_ns = can_frame_ns(DLC, wires.analog_bitrate)
    electrical.command_delay_ns = round(config.command_delay_ms * _MS)
    electrical.measurement_delay_ns = round(config.measurement_delay_ms * _MS)


def _fill_load(place: Any, load: LoadConfig) -> None:
    place.kind = LOAD_PAYLOAD if load.kind == "payload" else LOAD_CONTACT
    place.on_ns, place.off_ns = round(load.on_s * _S), round(load.off_s * _S)
    place.magnitude, place.angle_deg = load.size, load.angle_deg


def new_device(config: PlantConfig) -> InclinometerDevice:
    """The inclinometer as `[plant]` has it after power-up."""
    return InclinometerDevice(config.rate_hz, config.baud, config.bandwidth_hz)


def new_state(params: Any, device: InclinometerDevice, start_ns: int) -> Any:
    """The `STATE` of a rig that has been at rest, vented by its driver's watchdog, for long; its clock starts at `start_ns`."""
    state = new_record(STATE)
    state.start_ns = state.t_ns = state.reached_ns = start_ns
    rest_deg, air, electrical = params.mechanics.rest_deg, params.air, params.electrical
    state.x[ANGLE], state.x[SUPPLY], state.x[GAS_K] = rest_deg, air.supply_kpa, air.wall_k
    state.x[CREEP_0 : CREEP_0 + N_CREEP] = rest_deg
    state.memory.angle_deg, state.memory.inertia = rest_deg, 1.0
    state.sensed_supply_kpa = air.supply_kpa
    state.inclinometer.angle_deg = rest_deg
    state.driver.state, state.driver.watchdog_at_ns = DRIVER_WATCHDOG, NEVER_NS
    state.command_exhaust_ma = state.coil_exhaust_ma = min(electrical.vent_ma, electrical.current_max_ma)
    settle_inputs(params, state)
    if params.rig:
        drive_m2 = air.k_v1_exhaust * state.play_exhaust_ma - air.k_v6_exhaust
        state.x[AREA_OUT] = min(max(drive_m2, 0.0), air.exhaust.area_max_m2)
    state.next_echo_ns = start_ns + electrical.echo_phase_ns
    state.next_analog_ns = start_ns + electrical.analog_phase_ns
    state.next_truth_ns = start_ns
    state.t_ns -= 1  # so that a load at second 0 is a change
    plan_loads(params, state)
    plan_faults(params, state)
    state.t_ns = start_ns
    configure_inclinometer(params, state, device)
    state.next_inclinometer_ns = start_ns + electrical.inclinometer_phase_ns
    return state


def configure_inclinometer(params: Any, state: Any, device: InclinometerDevice) -> None:
    """Let the device's registers take effect: rate, content, filter, time on the wire."""
    inclinometer, before_ns = state.inclinometer, int(state.inclinometer.period_ns)
    inclinometer.period_ns, inclinometer.content = device.period_ns, device.content
    inclinometer.wire_ns = device.wire_ns
    inclinometer.lag_s = device.lag_s if params.electrical.inclinometer_lags else 0.0
    if inclinometer.period_ns == 0 or inclinometer.content == 0:
        state.next_inclinometer_ns = NEVER_NS
    elif inclinometer.period_ns != before_ns or state.next_inclinometer_ns == NEVER_NS:
        state.next_inclinometer_ns = state.reached_ns + inclinometer_period_ns(params.electrical, inclinometer.period_ns)
