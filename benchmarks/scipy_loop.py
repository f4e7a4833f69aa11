"""The closed loop as one would write it with scipy: the same controller, gate and devices, the rig's physics by `solve_ivp`.

The integration is restarted at every happening inside the rig (a frame, a sample, the truth), as inputs change there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from softloop.controller.command import fill_command
from softloop.controller.tick import controller_tick
from softloop.devices.gate_messages import give_command
from softloop.offline.closed_loop import RigTables, link_record, ready_controller
from softloop.offline.loop_kernels import hear_driver, run_gate, take_inclinations, take_pressures
from softloop.offline.loop_records import BETWEEN, INCLINATION, PRESSURE, no_records, push
from softloop.plant.electrical import _happen, accept_command, next_event_ns
from softloop.plant.mechanics import advance_memory
from softloop.plant.physics import _follow, block_kpa, decay_over, play, play_widths, slopes
from softloop.plant.records import ANGLE, EVENT, EVENT_ANALOG_FRAME, EVENT_DRIVER_FRAME, EVENT_INCLINOMETER, RATE, SUPPLY
from softloop.plant.setup import WireTimes, new_device, new_state, plant_record
from softloop.plant.spool import hold_in_stroke
from softloop.wire.kernel import new_record
from softloop.wire.schedule import PERIOD_NS, START_NS, make_schedule

RTOL = 1e-6
# Of angle, rate, chamber, tube, supply, gas, three creep angles, and both spools' areas (m2) and speeds.
ATOL = np.array([1e-5, 1e-3, 1e-4, 1e-4, 1e-4, 1e-4, 1e-5, 1e-5, 1e-5, 1e-11, 1e-8, 1e-11, 1e-8])


def advance(params: Any, state: Any, to_ns: int, method: str) -> None:
    """Bring physics and sensor lags to `to_ns`, as `plant.physics.advance` does."""
    if to_ns <= state.t_ns:
        return
    span_s, n, lag_s = 1e-9 * (to_ns - state.t_ns), int(params.n_states), params.air.coil_lag_s
    charge, exhaust = state.command_charge_ma, state.command_exhaust_ma
    charge_off, exhaust_off = state.coil_charge_ma - charge, state.coil_exhaust_ma - exhaust
    held_in, held_out = state.play_charge_ma, state.play_exhaust_ma
    width_in, width_out = play_widths(params, state)
    stage, slope = state.stage, state.slope

    def right_hand_side(time_s: float, x: np.ndarray) -> np.ndarray:
        stage[:n] = x
        left = decay_over(time_s, lag_s)
        felt_in = play(charge + charge_off * left, held_in, width_in)
        slopes(params, state, felt_in, play(exhaust + exhaust_off * left, held_out, width_out))
        return slope[:n].copy()

    before = state.x[SUPPLY], block_kpa(params, state), state.x[ANGLE], state.x[RATE]
    state.x[:n] = solve_ivp(right_hand_side, (0.0, span_s), state.x[:n], method=method, rtol=RTOL, atol=ATOL[:n]).y[:, -1]
    left = decay_over(span_s, lag_s)
    state.coil_charge_ma, state.coil_exhaust_ma = charge + charge_off * left, exhaust + exhaust_off * left
    state.play_charge_ma = play(state.coil_charge_ma, held_in, width_in)
    state.play_exhaust_ma = play(state.coil_exhaust_ma, held_out, width_out)
    advance_memory(params.mechanics, state.memory, state.x[ANGLE])
    hold_in_stroke(params.air, state)
    _follow_sensors(params, state, before, span_s)
    state.t_ns = to_ns


def _follow_sensors(params: Any, state: Any, before: tuple[float, float, float, float], span_s: float) -> None:
    sensor, x, block = state.inclinometer, state.x, block_kpa(params, state)
    lag_s = params.electrical.pressure_lag_s
    of_pressure, of_angle = (decay_over(span_s, lag_s), lag_s / span_s), (decay_over(span_s, sensor.lag_s), sensor.lag_s / span_s)
    state.sensed_supply_kpa = _follow(state.sensed_supply_kpa, before[0], x[SUPPLY], *of_pressure)
    state.sensed_chamber_kpa = _follow(state.sensed_chamber_kpa, before[1], block, *of_pressure)
    sensor.angle_deg = _follow(sensor.angle_deg, before[2], x[ANGLE], *of_angle)
    sensor.rate_deg_s = _follow(sensor.rate_deg_s, before[3], x[RATE], *of_angle)


def run_plant(params: Any, plant: Any, to_ns: int, events: np.ndarray, between: Any, method: str) -> None:
    """What `offline.loop_kernels.run_plant` does."""
    ways = {
        EVENT_ANALOG_FRAME: between.analog_way,
        EVENT_INCLINOMETER: between.serial_way,
        EVENT_DRIVER_FRAME: between.driver_way,
    }
    while (due_ns := next_event_ns(params, plant)) <= to_ns:
        advance(params, plant, due_ns, method)
        for event in events[: _happen(params, plant, events, 0, due_ns)]:
            if event.kind in ways:
                push(ways[event.kind], event)


def scipy_loop(tables: RigTables, seconds: float, method: str = "RK45") -> np.ndarray:
    """The rig's true angle at each tick, deg, (n,)."""
    built, plant, buses = ready_controller(tables.controller), tables.plant, tables.can
    params = plant_record(plant, WireTimes(buses[plant.can_valves].bitrate, buses[plant.can_analog].bitrate))
    state, between, events = new_state(params, new_device(plant), START_NS), new_record(BETWEEN), np.zeros(64, EVENT)
    link = link_record(tables, params, make_schedule(0.5, seconds, 0.0))
    between.analog.counter = -1
    inputs, cycle, angle = built.inputs[0], built.cycle[0], np.zeros(round(seconds * 1e9) // PERIOD_NS)
    no_pressures, no_inclinations = no_records(PRESSURE), no_records(INCLINATION)
    for k in range(len(angle)):
        now_ns = START_NS + (k + 1) * PERIOD_NS
        run_plant(params, state, now_ns, events, between, method)
        angle[k] = state.x[ANGLE]
        take_pressures(link, between, now_ns, inputs.pressure, no_pressures)
        take_inclinations(link, between, now_ns, inputs.inclination, no_inclinations)
        hear_driver(link, between, between.driver_way, now_ns)
        inputs.now_ns, inputs.tick = now_ns, k
        controller_tick(
            built.config[0], built.model[0], built.gains[0], built.plan.knots, built.plan.table, inputs, built.state[0],
            built.scratch[0], built.first[0], cycle,
        )  # fmt: skip
        sent_ns = now_ns + link.latency_ns
        fill_command(cycle, between.command)
        give_command(between.given, between.command, sent_ns)
        run_gate(link, between, sent_ns, inputs.valves)
        output, end_ns = between.output, sent_ns + link.valve_frame_ns
        accept_command(
            params, state, end_ns, output.charge_counts, output.exhaust_counts, output.output, between.frame.seq & 0xFFFF
        )
    return angle
