"""From the bench file's `[controller]` to the records that the kernels read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softloop.controller import references
from softloop.controller.config import ControllerConfig, ValveTestConfig
from softloop.controller.feasibility import check_angle_plan, check_pressure_plan
from softloop.controller.laws.arc import STEP1
from softloop.controller.records import (
    CONFIG,
    CONTROLLER_STATE,
    CYCLE,
    GAINS,
    INPUTS,
    LAWS,
    MODE_HOLD,
    MODE_RULES,
    OBSERVED_LAWS,
    PRESSURE_LAWS,
)
from softloop.controller.references import Plan
from softloop.controller.tick import SCRATCH, controller_tick_of_arrays
from softloop.dynamics.parameters import B0, Parameters, load_parameters, model_record, shipped
from softloop.wire.errors import BadConfig
from softloop.wire.kernel import new_record

PERIOD_NS = 5_000_000  # the paper's sampling time
MS = 1_000_000
VALVE_STEPS = "valve_steps"


@dataclass
class Controller:
    """One controller, ready to tick: its records, each an array of one, and its trajectory. `inputs` is filled from outside."""

    config: NDArray[Any]
    model: NDArray[Any]
    gains: NDArray[Any]
    plan: Plan
    inputs: NDArray[Any]
    state: NDArray[Any]
    cycle: NDArray[Any]
    scratch: NDArray[Any]
    first: NDArray[Any]

    def tick(self) -> Any:
        """Run one tick on `inputs`; returns the filled cycle record."""
        controller_tick_of_arrays(
            self.config, self.model, self.gains, self.plan.knots, self.plan.table, self.inputs, self.state, self.scratch,
            self.first, self.cycle,
        )  # fmt: skip
        return self.cycle[0]


def parameters_of(config: ControllerConfig) -> Parameters:
    """The parameter file a controller runs on. Raises BadFile or BadConfig."""
    named = shipped(config.parameters)
    return load_parameters(named if named.is_file() else Path(config.parameters))


def plan_of(config: ControllerConfig) -> Plan:
    """The trajectory a controller follows. Raises BadConfig when it does not fit the law, BadFile for a bad CSV file."""
    name, seed = config.trajectory, config.trajectory_seed
    excitations = {"excitation_1hz": 1.0, "excitation_05hz": 0.5}
    if (name == VALVE_STEPS) != (config.law == "valve_test"):
        raise BadConfig(f"[controller] trajectory '{VALVE_STEPS}' and law \"valve_test\" go together, and with no other")
    if name == VALVE_STEPS:
        return valve_plan(config.valve_test)
    if name in excitations:
        if config.law not in PRESSURE_LAWS:
            raise BadConfig(f"[controller] trajectory '{name}' is a pressure; it needs law = \"pressure\"")
        return references.excitation(excitations[name], seed)
    if name in ("t1", "t2"):
        if config.law in PRESSURE_LAWS:
            raise BadConfig(f"[controller] trajectory '{name}' is an angle; law \"pressure\" needs an excitation or a CSV in kPa")
        return references.point_to_point() if name == "t1" else references.t2(seed)
    path = Path(name)
    if not path.is_file():
        raise BadConfig(
            f"[controller] trajectory '{name}': no such file, and not one of t1, t2, {', '.join(excitations)}, {VALVE_STEPS}"
        )
    return references.from_csv(path)


def valve_plan(config: ValveTestConfig) -> Plan:
    """The currents of flow tests. Raises BadConfig."""
    if not config.first_ma < config.last_ma:
        raise BadConfig(f"[controller.valve_test] first_ma must be below last_ma ({config.last_ma:g}), got {config.first_ma:g}")
    currents = np.linspace(config.first_ma, config.last_ma, config.levels)
    return references.valve_steps(currents, config.test_s, config.fill_s, config.empty_s, config.rest_s)


def check_plan(config: ControllerConfig, plan: Plan, model: Any) -> None:
    """Raise BadConfig where the rig cannot do what the trajectory asks for."""
    if config.law in PRESSURE_LAWS:
        check_pressure_plan(plan, model)
    elif config.law != "valve_test":
        check_angle_plan(plan, model)
    elif config.valve_test.last_ma > model.current_max_ma:
        raise BadConfig(f"[controller.valve_test] last_ma must be at most the valves' {model.current_max_ma:g} mA")


def build(config: ControllerConfig, parameters: Parameters | None = None) -> Controller:
    """All records of a controller, on `parameters` where they are given and not on the file that `config` names.

    Raises BadFile or BadConfig; BadConfig too when the trajectory is not feasible.
    """
    model = model_record(parameters or parameters_of(config))
    plan = plan_of(config)
    check_plan(config, plan, model)
    state = np.zeros(1, CONTROLLER_STATE)
    state[0].theta[:] = model.theta
    state[0].mode = MODE_HOLD
    state[0].pressure_rate_hz = state[0].inclination_rate_hz = 1e9 / PERIOD_NS  # believed until ticks have shown otherwise
    return Controller(
        config=_array_of_one(config_record(config, plan)),
        model=_array_of_one(model),
        gains=_array_of_one(gains_record(config, model)),
        plan=plan,
        inputs=np.zeros(1, INPUTS),
        state=state,
        cycle=np.zeros(1, CYCLE),
        scratch=np.zeros(1, SCRATCH),
        first=np.zeros(1, STEP1),
    )


def _array_of_one(record: Any) -> NDArray[Any]:
    array = np.zeros(1, record.dtype)
    array[0] = record
    return array


def config_record(config: ControllerConfig, plan: Plan) -> Any:
    """The `CONFIG` record."""
    record = new_record(CONFIG)
    record.law = LAWS[config.law]
    record.period_ns = PERIOD_NS
    record.approach_ns = round(config.approach_s * 1e9)
    record.rest_deg_s = config.rest_deg_s
    record.plan_kind, record.plan_ns = plan.kind, plan.duration_ns
    record.pressure_budget_ns = round(config.pressure_budget_ms * MS)
    record.inclination_budget_ns = round(config.inclination_budget_ms * MS)
    record.input_rate_min_hz = config.input_rate_min_hz
    record.pressure_delay_ns = round(config.pressure_delay_ms * MS)
    record.inclination_delay_ns = round(config.inclination_delay_ms * MS)
    record.actuation_delay_ns = round(config.actuation_delay_ms * MS)
    record.predict = config.predict and config.law != "valve_test"  # what is on the port then is not what the model has
    record.observe = config.law in OBSERVED_LAWS
    return record


def gains_record(config: ControllerConfig, model: Any) -> Any:
    """The `GAINS` record; adaptation gains and rates are scaled by the width of each parameter's bounds."""
    gains = new_record(GAINS)
    actuation = config.actuation
    gains.actuation.rule = MODE_RULES[actuation.modes]
    gains.actuation.flow_hold_kpa_s = actuation.flow_hold_kpa_s
    gains.actuation.error_hold, gains.actuation.error_release = actuation.error_hold_deg, actuation.error_release_deg
    gains.actuation.rate_still_deg_s = actuation.rate_still_deg_s
    if config.law in PRESSURE_LAWS:  # its error is a pressure and its trajectory never dwells
        gains.actuation.rate_still_deg_s = -1.0
    gains.actuation.switch_ticks = actuation.switch_ticks
    gains.actuation.bias_fraction = actuation.bias_fraction
    gains.actuation.current_max_ma = model.current_max_ma
    for law in ("pid", "smc", "arc", "arc_eso", "pressure", "observer", "valve_test"):
        record, table = gains[law], getattr(config, law)
        for name in record.dtype.names:
            if name in type(table).model_fields and name not in ("gamma", "rate_limit"):
                record[name] = getattr(table, name)
    gains.observer.line_s = 1e-3 * config.observer.line_ms
    width = model.theta_max - model.theta_min
    gains.arc.gamma[:] = config.arc.gamma_valve * width**2
    gains.arc.gamma[: B0 + 1] = config.arc.gamma * width[: B0 + 1] ** 2
    gains.arc.rate_limit[:] = config.arc.rate_limit * width
    gains.arc_eso.gamma[: B0 + 1] = config.arc_eso.gamma * width[: B0 + 1] ** 2
    gains.arc_eso.rate_limit[:] = config.arc_eso.rate_limit * width
    return gains
