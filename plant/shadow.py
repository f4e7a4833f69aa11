"""A simulated plant that follows a rig: driven by the rig's valve currents, compared with the rig's sensors.

Pure: messages in, `ShadowDivergence` out, in the order of their stamps and of nothing else, so that equal messages give equal
numbers however they came.

Drift. Nothing but the gas in the chamber integrates: a flow that is a little wrong would carry the simulated pressure away
without end, while the bending settles to where the pressure holds it and forgets. So the chamber alone is corrected, as an
observer does, towards the measured pressure with the time constant `correction_s`, and never faster than `correction_max_kpa_s`:
a steady flow error of e kPa/s stands as a residual of e times `correction_s` instead of a ramp, and a sensor that lies cannot
drag the simulated plant along faster than that. The correction is published: it is part of the divergence.
"""

from __future__ import annotations

from collections import deque
from heapq import heappop, heappush
from itertools import count
from math import isfinite, nan, sqrt
from typing import Any

from softloop.devices.protocols.wire_time import can_frame_ns
from softloop.plant.physics import advance, settle_inputs
from softloop.plant.records import ANGLE, CHAMBER, CREEP_0, N_CREEP, RATE, TUBE
from softloop.plant.setup import DLC, WireTimes, new_device, new_state, plant_record
from softloop.plant.shadow_config import ShadowProcess
from softloop.wire.channels import INCLINATION, PRESSURE, SHADOW, VALVES
from softloop.wire.messages import constant, message

PERIOD_NS = round(1e9 / SHADOW.rate_hz)
AT_REST_KPA = 2.0  # below it the rig is vented, and its simulated twin begins as one that has been so for long
_GAP_S = 0.1  # what is corrected for one sample: no more than for such a gap before it
_WATCHDOG = constant("ValveStatus", "DRIVER_WATCHDOG")
_DIVERGENCE = message(SHADOW.message)
_CHANNELS = ("angle", "rate", "chamber", "supply")
_UNITS = dict(zip(_CHANNELS, ("deg", "deg_s", "kpa", "kpa"), strict=True))


class Window:
    """Residuals of one channel, the newest and their root mean square over the last `span_ns`."""

    def __init__(self, span_ns: int) -> None:
        self._span_ns = span_ns
        self._held: deque[tuple[int, float]] = deque()

    def add(self, stamp_ns: int, residual: float) -> None:
        self._held.append((stamp_ns, float(residual)))

    def look(self, now_ns: int) -> tuple[float, float]:
        """(newest, RMS) at `now_ns`; NaN where nothing came within the window."""
        while self._held and self._held[0][0] <= now_ns - self._span_ns:
            self._held.popleft()
        if not self._held:
            return nan, nan
        return self._held[-1][1], sqrt(sum(r * r for _, r in self._held) / len(self._held))


class Shadow:
    """The simulated plant and its account; `put` messages in any order, then `advance_to` a time by which all have arrived."""

    def __init__(self, process: ShadowProcess) -> None:
        """Raises BadFile or BadConfig when the parameter file is not usable."""
        table = self._table = process.table
        self._wires = WireTimes(process.valves_bitrate)
        self._params = plant_record(table.plant, self._wires)
        self._device = new_device(table.plant)
        self._frame_ns = can_frame_ns(DLC, process.valves_bitrate) + round(1e6 * table.command_delay_ms)
        self._waiting: list[tuple[int, int, str, Any]] = []
        self._numbers = count()
        self._windows = {name: Window(round(1e9 * table.window_s)) for name in _CHANNELS}
        self._state: Any = None
        self._first: dict[str, Any] = {}
        self._next_ns = self._since_ns = self._corrected_ns = 0
        self._correction_kpa_s = 0.0
        self.said = self.left_out = 0
        self._warm()

    def _warm(self) -> None:
        """Run the kernels once on a rig of no consequence."""
        state = new_state(self._params, self._device, 0)
        settle_inputs(self._params, state)
        advance(self._params, state, 2_000_000)

    def put(self, channel: str, sample: Any) -> None:
        """Take a message of the channel `valves`, `pressure` or `inclination`; one with a value that is no number is left out."""
        stamp_ns, values = _SORTED[channel](self, sample)
        if all(isfinite(value) for value in values):
            heappush(self._waiting, (stamp_ns, next(self._numbers), channel, values))
        else:
            self.left_out += 1

    def currents_of(self, status: Any) -> tuple[int, tuple[float, ...]]:
        """When the valves got which currents."""
        if self._table.currents == "measured" or status.driver == _WATCHDOG:
            return status.driver_stamp_ns, (status.charge_coil_ma, status.exhaust_coil_ma)
        return status.stamp_ns + self._frame_ns, (status.charge_current_ma, status.exhaust_current_ma)

    def advance_to(self, to_ns: int) -> list[Any]:
        """Simulate up to `to_ns` (rig clock); the `ShadowDivergence` messages of each `PERIOD_NS` on the way, oldest first."""
        said: list[Any] = []
        while self._waiting and self._waiting[0][0] <= to_ns:
            stamp_ns, _, channel, values = heappop(self._waiting)
            said += self._up_to(stamp_ns)
            if self._state is not None:
                advance(self._params, self._state, stamp_ns)
            self._take(stamp_ns, channel, values)
        return said + self._up_to(to_ns)

    def _up_to(self, to_ns: int) -> list[Any]:
        """Say how the plant stands at every full period up to a time.

        It is not brought to `to_ns` itself: where the steps of the integration lie must follow from the stamps alone.
        """
        said = []
        while self._state is not None and self._next_ns <= to_ns:
            advance(self._params, self._state, self._next_ns)
            said.append(self._divergence(self._next_ns))
            self._next_ns += PERIOD_NS
        return said

    def _take(self, stamp_ns: int, channel: str, values: tuple[float, ...]) -> None:
        if self._state is None:
            self._first[channel] = values
            if len(self._first) == len(_SORTED):
                self._begin(stamp_ns)
        elif channel == VALVES.name:
            self._drive(*values)
        elif stamp_ns < self._state.t_ns:
            self.left_out += 1
        elif channel == PRESSURE.name:
            self._compare_pressures(stamp_ns, *values)
        else:
            self._compare_bending(stamp_ns, *values)

    def _begin(self, at_ns: int) -> None:
        """Take the state from the rig: vented and at rest for long, or bent as it is measured now, its past unknown."""
        state = self._state = new_state(self._params, self._device, at_ns)
        chamber_kpa = _true_kpa(self._params.electrical.chamber, self._table.chamber_sensor, self._first[PRESSURE.name][0])
        angle_deg, rate_deg_s = self._first[INCLINATION.name]
        if chamber_kpa >= AT_REST_KPA:
            state.x[CHAMBER] = state.x[TUBE] = state.sensed_chamber_kpa = chamber_kpa
            state.x[ANGLE] = state.memory.angle_deg = state.inclinometer.angle_deg = angle_deg
            state.x[CREEP_0 : CREEP_0 + N_CREEP] = angle_deg
            state.x[RATE] = state.inclinometer.rate_deg_s = rate_deg_s
        self._drive(*self._first[VALVES.name])
        self._since_ns = self._corrected_ns = at_ns
        self._next_ns = (at_ns // PERIOD_NS + 1) * PERIOD_NS

    def _drive(self, charge_ma: float, exhaust_ma: float) -> None:
        limit = self._params.electrical.current_max_ma
        self._state.command_charge_ma = min(max(charge_ma, 0.0), limit)
        self._state.command_exhaust_ma = min(max(exhaust_ma, 0.0), limit)
        settle_inputs(self._params, self._state)

    def _compare_pressures(self, stamp_ns: int, chamber_kpa: float, supply_kpa: float) -> None:
        electrical, table, state = self._params.electrical, self._table, self._state
        residual = chamber_kpa - _reading_kpa(electrical.chamber, table.chamber_sensor, state.sensed_chamber_kpa)
        self._windows["chamber"].add(stamp_ns, residual)
        supply = _reading_kpa(electrical.supply, table.supply_sensor, state.sensed_supply_kpa)
        self._windows["supply"].add(stamp_ns, supply_kpa - supply)
        self._correct(stamp_ns, residual)

    def _correct(self, stamp_ns: int, residual_kpa: float) -> None:
        """Pull the chamber towards what was measured; see the module's text."""
        if self._table.correction_s == 0.0:
            return
        most = self._table.correction_max_kpa_s
        self._correction_kpa_s = min(max(residual_kpa / self._table.correction_s, -most), most)
        passed_s = min(1e-9 * (stamp_ns - self._corrected_ns), _GAP_S)
        self._corrected_ns = stamp_ns
        for place in (CHAMBER, TUBE):
            self._state.x[place] = max(self._state.x[place] + passed_s * self._correction_kpa_s, 0.0)

    def _compare_bending(self, stamp_ns: int, angle_deg: float, rate_deg_s: float) -> None:
        electrical, device = self._params.electrical, self._state.inclinometer
        self._windows["angle"].add(stamp_ns, angle_deg - device.angle_deg)
        simulated = electrical.gyro_scale * device.rate_deg_s + electrical.gyro_bias_deg_s
        self._windows["rate"].add(stamp_ns, rate_deg_s - simulated)

    def _divergence(self, now_ns: int) -> Any:
        found: dict[str, float] = {}
        for name, window in self._windows.items():
            newest, rms = window.look(now_ns)
            found |= {f"{name}_residual_{_UNITS[name]}": newest, f"{name}_rms_{_UNITS[name]}": rms}
        self.said += 1
        chamber = _reading_kpa(self._params.electrical.chamber, self._table.chamber_sensor, self._state.sensed_chamber_kpa)
        return _DIVERGENCE.make(
            seq=self.said,
            stamp_ns=now_ns,
            since_ns=self._since_ns,
            angle_deg=float(self._state.inclinometer.angle_deg),
            chamber_pressure_kpa=chamber,
            correction_kpa_s=self._correction_kpa_s,
            window_s=self._table.window_s,
            left_out=self.left_out,
            **found,
        )


_SORTED: dict[str, Any] = {
    VALVES.name: Shadow.currents_of,
    PRESSURE.name: lambda _, sample: (sample.stamp_ns, (sample.chamber_pressure_kpa, sample.supply_pressure_kpa)),
    INCLINATION.name: lambda _, sample: (sample.stamp_ns, (sample.angle_deg, sample.rate_deg_s)),
}


def _reading_kpa(specimen: Any, sheet: Any, pressure_kpa: float) -> float:
    """What this specimen of a sensor makes of a pressure, read by its data sheet; without noise and steps."""
    volts = specimen.zero_v + specimen.gain * pressure_kpa
    return float((volts - sheet.zero_v) / (sheet.full_v - sheet.zero_v) * sheet.span_kpa)


def _true_kpa(specimen: Any, sheet: Any, reading_kpa: float) -> float:
    """The pressure behind a reading."""
    volts = sheet.zero_v + reading_kpa / sheet.span_kpa * (sheet.full_v - sheet.zero_v)
    return float((volts - specimen.zero_v) / specimen.gain)
