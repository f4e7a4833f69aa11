"""The records the controller's kernels read and write: inputs, measurement, reference, gains, state."""

from __future__ import annotations

from softloop.dynamics.parameters import N_THETA
from softloop.wire.kernel import record_dtype, record_type
from softloop.wire.messages import constant, message

PHASE_WAIT = constant("CycleRecord", "PHASE_WAIT")
PHASE_APPROACH = constant("CycleRecord", "PHASE_APPROACH")
PHASE_TRACK = constant("CycleRecord", "PHASE_TRACK")
PHASE_DONE = constant("CycleRecord", "PHASE_DONE")
MODE_CHARGE = constant("ValveCommand", "MODE_CHARGE")
MODE_EXHAUST = constant("ValveCommand", "MODE_EXHAUST")
MODE_HOLD = constant("ValveCommand", "MODE_HOLD")
GATE_ARMED = constant("ValveStatus", "GATE_ARMED")
OUTPUT_PASS = constant("ValveStatus", "OUTPUT_PASS")
SAMPLE_OK = constant("PressureSample", "STATUS_OK")

LAW_PID, LAW_ARC, LAW_PRESSURE, LAW_SMC, LAW_ARC_ESO, LAW_PID_ESO, LAW_PRESSURE_ESO = 0, 1, 2, 3, 4, 5, 6
LAW_VALVE_TEST = 7
LAWS = {
    "pid": LAW_PID,
    "pid_eso": LAW_PID_ESO,
    "smc": LAW_SMC,
    "arc": LAW_ARC,
    "arc_eso": LAW_ARC_ESO,
    "pressure": LAW_PRESSURE,
    "pressure_eso": LAW_PRESSURE_ESO,
    "valve_test": LAW_VALVE_TEST,
}
ANGLE_LAWS = ("pid", "pid_eso", "smc", "arc", "arc_eso")
PRESSURE_LAWS = ("pressure", "pressure_eso")  # their trajectory is a pressure
# These are given the observer's state, the others the newest samples carried on.
OBSERVED_LAWS = ("arc_eso", "pid_eso", "pressure_eso")
MODES_TABLE_2, MODES_FLOW_DEMAND, MODES_LATCHED = 0, 1, 2
MODE_RULES = {"table2": MODES_TABLE_2, "flow": MODES_FLOW_DEMAND, "latched": MODES_LATCHED}

CYCLE = message("CycleRecord").dtype
# Places of `CycleRecord.internal`: the measurement that the law was given, then what the record would otherwise lack of the
# state after the tick (`recall` reads it back).
IN_CHAMBER_KPA, IN_SUPPLY_KPA, IN_PERIOD_S, IN_INTEGRAL_KPA, IN_MODE_TICKS = 0, 1, 2, 3, 4
IN_APPROACH_START, IN_CHARGE_BEFORE_MA, IN_EXHAUST_BEFORE_MA = 5, 6, 7
IN_PRESSURE_RATE_HZ, IN_INCLINATION_RATE_HZ = 8, 9
# Places of `CycleRecord.estimator`: the observer's scalars in the order of `OBSERVER_SCALARS`, how long before the tick it stands
# (ns, inclination and pressure), and from EST_FLOWS on its flows, newest first.
N_FLOWS = 32  # ticks of commands under way: 160 ms of delay and age together
EST_INCLINATION_NS, EST_PRESSURE_NS, EST_FLOWS = 14, 15, 16

# What lay on the inputs when the tick began: the newest message of each channel, whole.
INPUTS = record_dtype(
    [
        ("now_ns", "i8"),
        ("tick", "i8"),
        ("skipped", "i8"),
        ("pressure", message("PressureSample").dtype),
        ("inclination", message("InclinationSample").dtype),
        ("valves", message("ValveStatus").dtype),
    ]
)

# What a law works on: the state brought to the time at which its command will act.
MEASUREMENT = record_dtype(
    [
        ("angle_deg", "f8"),
        ("rate_deg_s", "f8"),
        ("chamber_kpa", "f8"),
        ("supply_kpa", "f8"),
        ("period_s", "f8"),  # since the last tick, skipped ones included
        ("disturbance_deg_s2", "f8"),  # what the observer adds to Eq. 2; 0 without an observer
        ("trust", "f8"),  # of the observer's model, 0 to 1; 1 without a trust gate
        ("adapt", "u1"),  # 1 where inputs are fresh and the last command was not saturated
    ]
)

# A point of a trajectory and its derivatives; of the angle in deg, or of the pressure in kPa for the pressure law.
REFERENCE = record_dtype([("value", "f8"), ("rate", "f8"), ("acceleration", "f8"), ("jerk", "f8")])

# What a law asks for, and what is worth logging of how it came to it.
DEMAND = record_dtype(
    [
        ("flow_kpa_s", "f8"),  # pressure rate asked of the valves
        ("desired_pressure_kpa", "f8"),
        ("error", "f8"),
        ("s1", "f8"),
        ("s2", "f8"),
        ("mode", "u1"),
    ]
)

# How demanded flow becomes a working mode and currents; the same for every law.
ACTUATION = record_dtype(
    [
        ("rule", "i8"),
        ("flow_hold_kpa_s", "f8"),  # below this no valve is opened
        ("error_hold", "f8"),  # epsilon_0 of Table 2, entering hold
        ("error_release", "f8"),  # leaving hold
        ("rate_still_deg_s", "f8"),  # a reference slower than this stands, where Table 2 says "= 0"
        ("switch_ticks", "i8"),  # a mode stays at least this long
        ("bias_fraction", "f8"),  # the closed valve waits at this fraction of its opening current
        ("current_max_ma", "f8"),
    ]
)

PID_GAINS = record_dtype(
    [(n, "f8") for n in ("kp", "ki", "kd", "kv", "ka", "integral_max_kpa", "pressure_gain", "desired_max_kpa")]
)
ARC_GAINS = record_dtype(
    [
        *[(n, "f8") for n in ("k_s", "k1", "k2", "rho", "epsilon1", "epsilon2", "delta1", "delta2", "desired_max_kpa")],
        ("gamma", "f8", (N_THETA,)),
        ("rate_limit", "f8", (N_THETA,)),
    ]
)
ARC_ESO_GAINS = record_dtype(
    [
        *[(n, "f8") for n in ("k_s", "k1", "k2", "rho", "desired_max_kpa", "cautious")],
        ("gamma", "f8", (N_THETA,)),  # composite adaptation by the observer's residual
        ("rate_limit", "f8", (N_THETA,)),
    ]
)
OBSERVER_GAINS = record_dtype(
    [
        ("rate_1_s", "f8"),  # bandwidths
        ("angle_1_s", "f8"),
        ("pressure_1_s", "f8"),
        ("line_s", "f8"),  # the chamber's pressure trails the sensor's block by this
        ("play_ma", "f8"),  # half width of the valves' hysteresis that is compensated
        ("play_still_ma", "f8"),  # a smaller change of the wanted current does not turn the play round
        ("teach_kpa", "f8"),  # below this chamber pressure the exhaust valve learns no faster than at it
        ("growth_1_deg", "f8"),  # part by which the chamber's volume grows per degree of bending
        ("whiteness", "f8"),  # |autocorrelation| of the innovation from which the model is not trusted; 0: always trusted
    ]
)
PRESSURE_GAINS = record_dtype([(n, "f8") for n in ("k2", "epsilon2", "delta2")])
VALVE_TEST_GAINS = record_dtype([("top_kpa", "f8"), ("low_kpa", "f8")])
GAINS = record_dtype(
    [
        ("actuation", ACTUATION),
        ("pid", PID_GAINS),
        ("arc", ARC_GAINS),
        ("pressure", PRESSURE_GAINS),
        ("smc", ARC_GAINS),
        ("arc_eso", ARC_ESO_GAINS),
        ("observer", OBSERVER_GAINS),
        ("valve_test", VALVE_TEST_GAINS),
    ]
)

PID_STATE = record_dtype([("integral_kpa", "f8")])
ARC_STATE = record_dtype([("phi", "f8", (N_THETA,)), ("tau", "f8", (N_THETA,))])
# What the observer knows: the mechanics at the inclinometer's newest stamp, the pressure at that of the pressure's, what the
# valves do that their model does not say, and the flows (kPa/s) of the commands under way, newest first.
OBSERVER_SCALARS = (
    "angle_deg",
    "rate_deg_s",
    "disturbance_deg_s2",
    "gyro_bias_deg_s",
    "chamber_kpa",
    "charge_offset_ma",  # by which a valve opens later than its model says
    "exhaust_offset_ma",
    "hold_kpa_s",  # pressure rate with both valves shut, beyond the model's
    "charge_play_ma",  # currents as the spools feel them, behind their hysteresis
    "exhaust_play_ma",
    "innovation_deg_s",  # gyro less observer, at the newest sample
    "innovation_power",  # running mean of its square, and of its product with the one before
    "innovation_pair",
)
OBSERVER_STATE = record_dtype(
    [
        *[(n, "f8") for n in OBSERVER_SCALARS],
        ("flow_kpa_s", "f8", (N_FLOWS,)),
        ("inclination_ns", "i8"),  # stamps of the samples up to which it has been brought
        ("pressure_ns", "i8"),
    ]
)
CONTROLLER_STATE = record_dtype(
    [
        ("theta", "f8", (N_THETA,)),
        ("seq", "i8"),
        ("skipped_total", "i8"),
        ("last_ns", "i8"),
        ("phase_start_ns", "i8"),
        ("approach", "f8", (8,)),
        ("approach_ns", "i8"),
        ("charge_ma", "f8"),  # the last two commands, for prediction
        ("exhaust_ma", "f8"),
        ("charge_before_ma", "f8"),
        ("exhaust_before_ma", "f8"),
        ("mode_ticks", "i8"),
        ("pressure_seq", "i8"),  # the samples of the tick before, and how often a tick found a newer one, 1/s
        ("inclination_seq", "i8"),
        ("pressure_rate_hz", "f8"),
        ("inclination_rate_hz", "f8"),
        ("pid", PID_STATE),
        ("arc", ARC_STATE),
        ("observer", OBSERVER_STATE),  # before the bytes: nested records must stay aligned
        ("phase", "u1"),
        ("mode", "u1"),
        ("saturated", "u1"),
        ("started", "u1"),
    ]
)

CONFIG = record_dtype(
    [
        ("law", "i8"),
        ("period_ns", "i8"),
        ("approach_ns", "i8"),
        ("plan_kind", "i8"),
        ("plan_ns", "i8"),
        ("pressure_budget_ns", "i8"),
        ("inclination_budget_ns", "i8"),
        ("pressure_delay_ns", "i8"),  # declared lag of the sensor ahead of its stamp
        ("inclination_delay_ns", "i8"),
        ("actuation_delay_ns", "i8"),  # from tick to valve opening
        ("rest_deg_s", "f8"),  # the approach begins at no higher rate
        ("input_rate_min_hz", "f8"),  # below it nothing is adapted
        ("predict", "u1"),
        ("observe", "u1"),  # the law is given the observer's state
    ]
)

INPUTS_TYPE = record_type(INPUTS)
MEASUREMENT_TYPE = record_type(MEASUREMENT)
REFERENCE_TYPE = record_type(REFERENCE)
DEMAND_TYPE = record_type(DEMAND)
ACTUATION_TYPE = record_type(ACTUATION)
GAINS_TYPE = record_type(GAINS)
PID_GAINS_TYPE = record_type(PID_GAINS)
ARC_GAINS_TYPE = record_type(ARC_GAINS)
PRESSURE_GAINS_TYPE = record_type(PRESSURE_GAINS)
ARC_ESO_GAINS_TYPE = record_type(ARC_ESO_GAINS)
OBSERVER_GAINS_TYPE = record_type(OBSERVER_GAINS)
OBSERVER_TYPE = record_type(OBSERVER_STATE)
PID_STATE_TYPE = record_type(PID_STATE)
ARC_STATE_TYPE = record_type(ARC_STATE)
STATE_TYPE = record_type(CONTROLLER_STATE)
CONFIG_TYPE = record_type(CONFIG)
CYCLE_TYPE = record_type(CYCLE)
