"""The rig's electrical side: valve driver and analogue module on CAN, inclinometer on serial, each on its own clock.

`run_until` lets everything up to a time happen, in time order. The physics is brought forward only from one happening to the
next, so that its steps, and with them every bit, depend on what happens and not on when the caller looks.

Where several happen at the same instant, the order is: valve frame, driver's watchdog, load, fault, driver's status frame,
analogue module, inclinometer, truth.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types

from softloop.devices.protocols.quantise_kernels import counts_to_current, current_to_counts, deg_to_counts, value_to_int16
from softloop.dynamics.noise import gaussian
from softloop.plant.faults import change_faults
from softloop.plant.loads import change_loads
from softloop.plant.physics import advance, settle_inputs
from softloop.plant.records import (
    ELECTRICAL_TYPE,
    EVENT_ANALOG_FRAME,
    EVENT_DRIVER,
    EVENT_DRIVER_FRAME,
    EVENT_INCLINOMETER,
    EVENT_TRUTH,
    EVENTS_TYPE,
    MAX_FAULTS,
    MAX_LOADS,
    PLANT_TYPE,
    QUEUE,
    SENSOR_TYPE,
    STATE_TYPE,
)
from softloop.plant.truth import note_truth
from softloop.wire.kernel import kernel
from softloop.wire.messages import constant

_F8, _I8, _B1 = types.f8, types.i8, types.b1
_VOID = types.void

DRIVER_OK = constant("ValveStatus", "DRIVER_OK")
DRIVER_WATCHDOG = constant("ValveStatus", "DRIVER_WATCHDOG")
NEVER_NS = np.iinfo(np.int64).max
SAMPLE_GUARD = max(MAX_LOADS, MAX_FAULTS) + 1  # free places in `events` that one happening may need

# Noise sources; see `dynamics.noise`.
_NOISE_SUPPLY, _NOISE_CHAMBER, _NOISE_ANGLE, _NOISE_RATE, _NOISE_COIL_IN, _NOISE_COIL_OUT = 1, 2, 3, 4, 5, 6
_ADC_HALF = 2048.0  # 12 bits over -10 V to 10 V
_ADC_SHIFT = 16  # left-justified in 16 bits
_ADC_FULL_V = 10.0
_GYRO_FULL_DEG_S = 2000.0


@kernel(_B1(PLANT_TYPE, STATE_TYPE, _I8, _I8, _I8, _I8, _I8))
def accept_command(params: Any, state: Any, end_ns: int, raw_charge: int, raw_exhaust: int, output: int, seq: int) -> bool:
    """Hand the driver a valve frame that has passed its checks.

    It takes effect at its end on the wire plus the configured delay, or, where the physics is past that, at once.

    Args:
        end_ns: rig clock, end of the frame on the wire.
        raw_charge, raw_exhaust: counts of 0.01 mA.
        output, seq: as the frame carries them.

    Returns:
        False when the queue is full; the frame is dropped and counted.
    """
    driver = state.driver
    if driver.waiting >= QUEUE:
        driver.refused += 1
        return False
    frame = driver.queue[(driver.head + driver.waiting) % QUEUE]
    frame.end_ns, frame.charge, frame.exhaust, frame.output, frame.seq = end_ns, raw_charge, raw_exhaust, output, seq
    due = end_ns + params.electrical.command_delay_ns
    if driver.waiting > 0:
        due = max(due, driver.queue[(driver.head + driver.waiting - 1) % QUEUE].due_ns)
    frame.due_ns = due
    driver.waiting += 1
    return True


@kernel(_I8(STATE_TYPE))
def _frame_due_ns(state: Any) -> int:
    driver = state.driver
    if driver.waiting == 0:
        return NEVER_NS
    return max(driver.queue[driver.head].due_ns, state.t_ns)


@kernel(_I8(PLANT_TYPE, STATE_TYPE))
def next_event_ns(params: Any, state: Any) -> int:
    """Rig clock of the next happening inside the rig."""
    due = min(_frame_due_ns(state), state.driver.watchdog_at_ns, state.next_load_ns, state.next_fault_ns)
    return min(due, state.next_echo_ns, state.next_analog_ns, state.next_inclinometer_ns, state.next_truth_ns)


@kernel(_I8(EVENTS_TYPE, _I8, _I8, _I8, _I8))
def _write(events: np.ndarray, n: int, kind: int, sample_ns: int, end_ns: int) -> int:
    event = events[n]
    event.kind, event.sample_ns, event.end_ns, event.value = kind, sample_ns, end_ns, 0.0
    for i in range(4):
        event.raw[i] = 0
    return n + 1


@kernel(_VOID(PLANT_TYPE, STATE_TYPE, _F8, _F8))
def _drive(params: Any, state: Any, charge_ma: float, exhaust_ma: float) -> None:
    limit = params.electrical.current_max_ma
    state.command_charge_ma = min(charge_ma, limit)
    state.command_exhaust_ma = min(exhaust_ma, limit)
    settle_inputs(params, state)


@kernel(_I8(PLANT_TYPE, STATE_TYPE, EVENTS_TYPE, _I8))
def _apply_frame(params: Any, state: Any, events: np.ndarray, n: int) -> int:
    """The driver takes the oldest frame of its queue, when that reaches it."""
    driver = state.driver
    frame = driver.queue[driver.head]
    if state.broken.commands_lost or state.broken.power_lost:
        driver.head = (driver.head + 1) % QUEUE
        driver.waiting -= 1
        return n
    _drive(params, state, counts_to_current(frame.charge), counts_to_current(frame.exhaust))
    driver.seq = frame.seq
    driver.accepted += 1
    driver.command_end_ns, driver.command_applied_ns = frame.end_ns, state.t_ns
    driver.watchdog_at_ns = state.t_ns + params.electrical.watchdog_ns
    driver.head = (driver.head + 1) % QUEUE
    driver.waiting -= 1
    if driver.state != DRIVER_OK:
        driver.state = DRIVER_OK
        n = _write(events, n, EVENT_DRIVER, state.t_ns, state.t_ns)
        events[n - 1].raw[0] = DRIVER_OK
    return n


@kernel(_I8(PLANT_TYPE, STATE_TYPE, EVENTS_TYPE, _I8))
def _watchdog(params: Any, state: Any, events: np.ndarray, n: int) -> int:
    """No good frame in time: the driver vents by itself, unless it has no power."""
    if state.broken.power_lost:
        state.driver.watchdog_at_ns = NEVER_NS
        return n
    _drive(params, state, 0.0, params.electrical.vent_ma)
    state.driver.state = DRIVER_WATCHDOG
    state.driver.watchdog_at_ns = NEVER_NS
    n = _write(events, n, EVENT_DRIVER, state.t_ns, state.t_ns)
    events[n - 1].raw[0] = DRIVER_WATCHDOG
    return n


@kernel(_I8(PLANT_TYPE, STATE_TYPE, EVENTS_TYPE, _I8))
def _echo(params: Any, state: Any, events: np.ndarray, n: int) -> int:
    """The driver's status frame with the coil currents it measures."""
    electrical = params.electrical
    if state.broken.driver_silent or state.broken.power_lost:
        state.echoes += 1
        state.next_echo_ns += electrical.echo_period_ns
        return n
    n = _write(
        events, n, EVENT_DRIVER_FRAME, state.t_ns, state.t_ns + electrical.driver_frame_ns + electrical.measurement_delay_ns
    )
    noise_in = electrical.coil_noise_ma * gaussian(params.seed, _NOISE_COIL_IN, state.echoes)
    noise_out = electrical.coil_noise_ma * gaussian(params.seed, _NOISE_COIL_OUT, state.echoes)
    event = events[n - 1]
    event.raw[0] = current_to_counts(state.coil_charge_ma + noise_in)
    event.raw[1] = current_to_counts(state.coil_exhaust_ma + noise_out)
    event.raw[2] = state.driver.state
    event.raw[3] = state.driver.seq
    state.echoes += 1
    state.next_echo_ns += electrical.echo_period_ns
    return n


@kernel(_I8(SENSOR_TYPE, _F8, _F8))
def _adc(sensor: Any, pressure_kpa: float, unit_noise: float) -> int:
    """Counts of a pressure: sensor voltage with its errors, then 12 bits, left-justified in 16."""
    volts = sensor.zero_v + sensor.gain * pressure_kpa + sensor.noise_v * unit_noise
    code = volts / _ADC_FULL_V * _ADC_HALF
    return _ADC_SHIFT * round(min(max(code, -_ADC_HALF), _ADC_HALF - 1.0))


@kernel(_I8(PLANT_TYPE, STATE_TYPE, EVENTS_TYPE, _I8))
def _sample_pressures(params: Any, state: Any, events: np.ndarray, n: int) -> int:
    """The analogue module's frame."""
    electrical, count, broken = params.electrical, state.analog_samples, state.broken
    state.analog_samples += 1
    state.next_analog_ns += electrical.analog_period_ns
    noise = 1.0 + broken.noise
    supply = _adc(electrical.supply, state.sensed_supply_kpa, noise * gaussian(params.seed, _NOISE_SUPPLY, count))
    sensed_kpa = state.sensed_chamber_kpa + broken.chamber_bias_kpa
    if not broken.chamber_stuck:
        state.held_chamber = _adc(electrical.chamber, sensed_kpa, noise * gaussian(params.seed, _NOISE_CHAMBER, count))
    if broken.analog_silent:
        return n
    n = _write(
        events, n, EVENT_ANALOG_FRAME, state.t_ns, state.t_ns + electrical.analog_frame_ns + electrical.measurement_delay_ns
    )
    event = events[n - 1]
    event.raw[0], event.raw[1], event.raw[2] = supply, state.held_chamber, count % 256
    return n


@kernel(_I8(ELECTRICAL_TYPE, _I8))
def inclinometer_period_ns(electrical: Any, nominal_ns: int) -> int:
    """The inclinometer's period on the rig clock."""
    return round(nominal_ns * (1.0 + electrical.clock_error))


@kernel(_I8(PLANT_TYPE, STATE_TYPE, EVENTS_TYPE, _I8))
def _sample_inclinometer(params: Any, state: Any, events: np.ndarray, n: int) -> int:
    """The inclinometer's packets of one sample."""
    electrical, device, count, broken = params.electrical, state.inclinometer, state.inclinometer_samples, state.broken
    state.inclinometer_samples += 1
    state.next_inclinometer_ns += inclinometer_period_ns(electrical, device.period_ns)
    noise = 1.0 + broken.noise
    rate_noise = noise * electrical.rate_noise_deg_s * gaussian(params.seed, _NOISE_RATE, count)
    angle_noise = noise * electrical.angle_noise_deg * gaussian(params.seed, _NOISE_ANGLE, count)
    rate = electrical.gyro_scale * device.rate_deg_s + electrical.gyro_bias_deg_s + broken.rate_bias_deg_s + rate_noise
    angle = device.angle_deg + broken.angle_bias_deg + angle_noise
    if not broken.angle_stuck:
        state.held_rate, state.held_angle = value_to_int16(rate, _GYRO_FULL_DEG_S), deg_to_counts(angle)
    if broken.inclinometer_silent:
        return n
    n = _write(events, n, EVENT_INCLINOMETER, state.t_ns, state.t_ns + device.wire_ns + electrical.measurement_delay_ns)
    event = events[n - 1]
    event.raw[0], event.raw[1], event.raw[2] = state.held_rate, state.held_angle, device.content
    return n


@kernel(_I8(PLANT_TYPE, STATE_TYPE, EVENTS_TYPE, _I8, _I8))
def _happen(params: Any, state: Any, events: np.ndarray, n: int, due_ns: int) -> int:
    """Let the first of what is due at `due_ns` happen; the physics is there."""
    if due_ns == _frame_due_ns(state):
        return _apply_frame(params, state, events, n)
    if due_ns == state.driver.watchdog_at_ns:
        return _watchdog(params, state, events, n)
    if due_ns == state.next_load_ns:
        return change_loads(params, state, events, n)
    if due_ns == state.next_fault_ns:
        n = change_faults(params, state, events, n)
        if state.broken.power_lost:  # the coils let go; a driver that comes back starts in its watchdog's vent
            _drive(params, state, 0.0, 0.0)
            state.driver.state = DRIVER_WATCHDOG
            state.driver.watchdog_at_ns = NEVER_NS
        return n
    if due_ns == state.next_echo_ns:
        return _echo(params, state, events, n)
    if due_ns == state.next_analog_ns:
        return _sample_pressures(params, state, events, n)
    if due_ns == state.next_inclinometer_ns:
        return _sample_inclinometer(params, state, events, n)
    note_truth(params, state)
    state.next_truth_ns += params.electrical.truth_period_ns
    return _write(events, n, EVENT_TRUTH, due_ns, due_ns)


@kernel(_I8(PLANT_TYPE, STATE_TYPE, _I8, EVENTS_TYPE))
def run_until(params: Any, state: Any, to_ns: int, events: np.ndarray) -> int:
    """Let everything inside the rig up to and at `to_ns` (rig clock) happen, in time order.

    Args:
        events: shape (n,), n > 17, written from the start with what leaves the rig.

    Returns:
        How many events were written. It returns early after an EVENT_TRUTH, so that the caller can take `state.truth`, and
        when `events` is nearly full: call again while `state.reached_ns < to_ns`.
    """
    n = 0
    while n + SAMPLE_GUARD <= len(events):
        due_ns = next_event_ns(params, state)
        if due_ns > to_ns:
            state.reached_ns = to_ns
            break
        advance(params, state, due_ns)
        n = _happen(params, state, events, n, due_ns)
        if events[n - 1].kind == EVENT_TRUTH and n > 0:
            break
    return n
