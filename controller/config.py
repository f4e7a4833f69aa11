"""`[controller]` of the bench file."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from softloop.wire.benchfile import ProcessTable, Table


class ActuationConfig(Table):
    """`[controller.actuation]`: from demanded flow to working mode and currents."""

    modes: Literal["table2", "flow", "latched"] = Field(
        "flow",
        description="the paper's Table 2, or the demanded flow: its sign, or its sign beyond flow_hold_kpa_s",
    )
    flow_hold_kpa_s: float = Field(4.0, ge=0, description="a smaller demand opens no valve")
    error_hold_deg: float = Field(0.1, ge=0, description="epsilon_0: on a dwell, hold below this error")
    error_release_deg: float = Field(0.2, ge=0, description="and leave hold above this one")
    rate_still_deg_s: float = Field(0.5, ge=0, description="a slower reference counts as a dwell")
    switch_ticks: int = Field(3, ge=1, le=200, description="a mode stays at least this many ticks")
    bias_fraction: float = Field(0.8, ge=0, le=0.95, description="the closed valve waits at this part of its opening current")


class PidConfig(Table):
    """`[controller.pid]`: C1; pressure in kPa from angle in deg."""

    kp: float = Field(1.0, ge=0, description="proportional gain, kPa/deg")
    ki: float = Field(4.0, ge=0, description="integral gain, kPa/(deg s)")
    kd: float = Field(0.08, ge=0, description="derivative gain, kPa s/deg")
    kv: float = Field(0.24, ge=0, description="velocity feedforward; nominal c0 / b0")
    ka: float = Field(0.0155, ge=0, description="acceleration feedforward; nominal 1 / b0")
    integral_max_kpa: float = Field(180.0, gt=0, description="bound of the integral's part, either way")
    pressure_gain: float = Field(20.0, gt=0, description="1/s, pressure error to flow")
    desired_max_kpa: float = Field(150.0, gt=0, description="the law asks for no higher chamber pressure")


class ArcConfig(Table):
    """`[controller.arc]`: C3, Eqs. 33 to 48."""

    k_s: float = Field(15.0, gt=0, description="K_S1, 1/s")
    k1: float = Field(30.0, gt=0, description="K_1, 1/s")
    k2: float = Field(50.0, gt=0, description="K_2, 1/s")
    rho: float = Field(10.0, gt=0, description="weight of S2 in V2; 1 is the paper's text")
    epsilon1: float = Field(5.0e4, gt=0, description="(deg/s)^2/s, Eq. 38")
    epsilon2: float = Field(1.0e5, gt=0, description="kPa^2/s, Eq. 47")
    delta1: float = Field(100.0, ge=0, description="bound of Delta_1, deg/s2")
    delta2: float = Field(60.0, ge=0, description="bound of Delta_2, kPa/s")
    gamma: float = Field(5.0e-5, ge=0, description="adaptation gain of the mechanics, times theta_M^2")
    gamma_valve: float = Field(3.0e-6, ge=0, description="adaptation gain of valves and leak, times theta_M^2")
    rate_limit: float = Field(0.5, gt=0, description="an estimate moves at most this part of its range in 1 s")
    desired_max_kpa: float = Field(150.0, gt=0, description="the law asks for no higher chamber pressure")


class SmcConfig(Table):
    """`[controller.smc]`: C2, the law of [controller.arc] without adaptation."""

    k_s: float = Field(15.0, gt=0, description="K_S1, 1/s")
    k1: float = Field(30.0, gt=0, description="K_1, 1/s")
    k2: float = Field(50.0, gt=0, description="K_2, 1/s")
    rho: float = Field(10.0, gt=0, description="weight of S2 in V2; 1 is the paper's text")
    epsilon1: float = Field(5.0e4, gt=0, description="(deg/s)^2/s, Eq. 38")
    epsilon2: float = Field(1.0e5, gt=0, description="kPa^2/s, Eq. 47")
    delta1: float = Field(100.0, ge=0, description="bound of Delta_1, deg/s2")
    delta2: float = Field(60.0, ge=0, description="bound of Delta_2, kPa/s")
    desired_max_kpa: float = Field(150.0, gt=0, description="the law asks for no higher chamber pressure")


class ArcEsoConfig(Table):
    """`[controller.arc_eso]`: weighted backstepping on the observer's state."""

    k_s: float = Field(15.0, gt=0, description="K_S1, 1/s")
    k1: float = Field(30.0, gt=0, description="K_1, 1/s")
    k2: float = Field(50.0, gt=0, description="K_2, 1/s")
    rho: float = Field(10.0, gt=0, description="weight of S2 in V2")
    gamma: float = Field(0.0, ge=0, description="composite adaptation by the residual, times theta_M^2; 0: none")
    rate_limit: float = Field(0.5, gt=0, description="an estimate moves at most this part of its range in 1 s")
    cautious: float = Field(0.5, gt=0, le=1, description="part of k1 and k2 that is left where the trust gate is shut")
    desired_max_kpa: float = Field(150.0, gt=0, description="the law asks for no higher chamber pressure")


class ObserverConfig(Table):
    """`[controller.observer]`: of the laws arc_eso and pid_eso."""

    rate_1_s: float = Field(60.0, gt=0, description="bandwidth of rate and disturbance, from the gyro")
    angle_1_s: float = Field(8.0, gt=0, description="bandwidth of angle and gyro bias, from the angle")
    pressure_1_s: float = Field(50.0, gt=0, description="bandwidth of pressure and the valves' offsets")
    line_ms: float = Field(3.0, ge=0, le=50, description="the chamber's pressure trails the sensor's by this")
    play_ma: float = Field(8.0, ge=0, le=30, description="half the width of the valves' hysteresis that is undone")
    play_still_ma: float = Field(0.5, ge=0, description="a smaller change of the wanted current does not turn the play round")
    teach_kpa: float = Field(
        0.0,
        ge=0,
        le=100,
        description="below this pressure, where little flows, the exhaust valve's offset is learned as slowly as at it",
    )
    growth_1_deg: float = Field(0.0, ge=0, le=0.02, description="part by which the chamber's volume grows per degree of bending")
    whiteness: float = Field(0.0, ge=0, le=1, description="trust gate: autocorrelation of the innovation that shuts it; 0: none")


class PressureConfig(Table):
    """`[controller.pressure]`: step 2 alone, in both laws that track a pressure."""

    k2: float = Field(30.0, gt=0, description="K_2, 1/s")
    epsilon2: float = Field(1.0e3, gt=0, description="kPa^2/s, Eq. 47")
    delta2: float = Field(60.0, ge=0, description="bound of Delta_2, kPa/s")


class ValveTestConfig(Table):
    """`[controller.valve_test]`: flow tests of the valves; for each current a test of both, with a full and an empty tank."""

    first_ma: float = Field(70.0, gt=0, description="lowest current")
    last_ma: float = Field(170.0, gt=0, description="highest current; it also fills and empties between tests")
    levels: int = Field(8, ge=2, le=50, description="how many currents, evenly from the lowest to the highest")
    test_s: float = Field(6.0, gt=0, le=60, description="length of one test")
    fill_s: float = Field(5.0, ge=0, le=60, description="at the highest current, before an exhaust test")
    empty_s: float = Field(9.0, ge=0, le=60, description="likewise before the next charge test")
    rest_s: float = Field(1.0, gt=0, le=60, description="both valves shut, between any two")
    top_kpa: float = Field(160.0, gt=0, description="the charge valve is shut at this chamber pressure")
    low_kpa: float = Field(2.0, gt=0, description="the exhaust valve at this one")


class ControllerConfig(ProcessTable):
    """`[controller]`: the law, its trajectory, and what it is told of delays and budgets."""

    law: Literal["pid", "pid_eso", "smc", "arc", "arc_eso", "pressure", "pressure_eso", "valve_test"] = Field(
        "arc",
        description="C1, C1 with our observer, C2, C3, ours; step 2 of C3 alone, also with our observer; currents as planned",
    )
    parameters: str = Field("table1", description="a shipped parameter set, or the path of a parameter file")
    trajectory: str = Field("t1", description="t1, t2, excitation_1hz, excitation_05hz, valve_steps, or a CSV file's path")
    trajectory_seed: int = Field(1, ge=0, le=2**32 - 1, description="phases of the multi-sines")
    approach_s: float = Field(4.0, gt=0, le=60, description="length of the smooth move to the first point")
    rest_deg_s: float = Field(
        10.0, gt=0, description="an armed rig that moves faster waits, both valves shut, before it approaches"
    )
    predict: bool = Field(True, description="carry the measured state on to the time at which the command acts")
    actuation_delay_ms: float = Field(3.0, ge=0, le=160, description="declared, from tick to valve opening")
    pressure_delay_ms: float = Field(1.5, ge=0, le=100, description="declared lag of the pressure sensor before its stamp")
    inclination_delay_ms: float = Field(1.0, ge=0, le=100, description="declared lag of the inclinometer before its stamp")
    pressure_budget_ms: float = Field(20.0, gt=0, description="an older pressure is not valid")
    inclination_budget_ms: float = Field(30.0, gt=0, description="an older inclination is not valid")
    input_rate_min_hz: float = Field(
        100.0,
        ge=0,
        le=200,
        description="nothing is adapted while a sensor's new samples come less often; half of both devices' rate",
    )
    actuation: ActuationConfig = ActuationConfig()
    pid: PidConfig = PidConfig()
    smc: SmcConfig = SmcConfig()
    arc: ArcConfig = ArcConfig()
    arc_eso: ArcEsoConfig = ArcEsoConfig()
    observer: ObserverConfig = ObserverConfig()
    pressure: PressureConfig = PressureConfig()
    valve_test: ValveTestConfig = ValveTestConfig()
