"""The records that the plant's kernels read (PLANT) and change (STATE), and the events they hand out (EVENT)."""

from __future__ import annotations

from softloop.dynamics.parameters import N_THETA, VALVE_SHAPE
from softloop.wire.kernel import array_of, record_dtype, record_type
from softloop.wire.messages import message

# Places of the integrated state. The ideal layer has the first three only.
ANGLE, RATE, CHAMBER, TUBE, SUPPLY, GAS_K, CREEP_0 = 0, 1, 2, 3, 4, 5, 6
N_CREEP = 3
AREA_IN, SPEED_IN, AREA_OUT, SPEED_OUT = 9, 10, 11, 12  # orifice areas (m2) and their rates (m2/s)
N_STATES = 13
N_IDEAL = 3
N_VALVES = 2
N_STOPS = 4  # stop operators of the actuator's hysteresis
MAX_LOADS = 16
MAX_FAULTS = 16
QUEUE = 256  # valve frames under way: 1.28 s of them at 200 Hz

EVENT_DRIVER_FRAME, EVENT_ANALOG_FRAME, EVENT_INCLINOMETER, EVENT_TRUTH, EVENT_LOAD, EVENT_DRIVER = 1, 2, 3, 4, 5, 6
EVENT_FAULT = 7
LOAD_PAYLOAD, LOAD_CONTACT = 1, 2
CONTENT_GYRO, CONTENT_ANGLE = 1, 2

# The mechanics: Eq. 2 with what the paper's model leaves out.
MECHANICS = record_dtype(
    [
        ("theta", "f8", (N_THETA,)),  # of this actuator, in the order of Eq. 24
        ("rest_deg", "f8"),
        ("stop_stiffness", "f8", (N_STOPS,)),  # 1/s2
        ("stop_deg", "f8", (N_STOPS,)),
        ("creep_stiffness", "f8", (N_CREEP,)),  # 1/s2
        ("creep_rate", "f8", (N_CREEP,)),  # 1/s
        ("payload_arm_m", "f8"),
        ("contact_s_deg", "f8"),  # damping per penetration rate
        ("memory", "u1"),  # hysteresis and creep are on
    ]
)
# The air: supply, valves, tube, chamber.
AIR = record_dtype(
    [
        ("charge", VALVE_SHAPE),
        ("exhaust", VALVE_SHAPE),
        ("k_v1_charge", "f8"),
        ("k_v6_charge", "f8"),
        ("k_v1_exhaust", "f8"),
        ("k_v6_exhaust", "f8"),
        ("leak_m2", "f8"),
        ("leak_laminar_kg_s_pa", "f8"),
        ("flow_scale", "f8"),  # C_f / sqrt(T), 1/sqrt(K)
        ("wall_k", "f8"),  # temperature of walls, tube and supply
        ("exponent", "f8"),  # kappa with a gas temperature state, 1 when isothermal
        ("wall_w_k", "f8"),  # heat conductance between gas and wall
        ("volume_m3", "f8"),  # of the chamber at the reference angle
        ("volume_per_deg", "f8"),
        ("volume_angle_deg", "f8"),
        ("tube_volume_m3", "f8"),
        ("tube_kg_s_pa2", "f8"),  # mass flow per difference of squared pressures
        ("supply_kpa", "f8"),
        ("supply_droop_kpa_s_kg", "f8"),
        ("supply_rate", "f8"),  # 1/s
        ("spool_rad_s", "f8"),
        ("spool_damping", "f8"),
        ("coil_lag_s", "f8"),
        ("play_charge_ma", "f8"),  # half width of the hysteresis loop
        ("play_exhaust_ma", "f8"),
    ]
)
SENSOR = record_dtype(
    [
        ("gain", "f8"),  # volts per true kPa
        ("zero_v", "f8"),
        ("noise_v", "f8"),
    ]
)
ELECTRICAL = record_dtype(
    [
        ("supply", SENSOR),
        ("chamber", SENSOR),
        ("pressure_lag_s", "f8"),
        ("gyro_bias_deg_s", "f8"),
        ("gyro_scale", "f8"),
        ("angle_noise_deg", "f8"),
        ("rate_noise_deg_s", "f8"),
        ("coil_noise_ma", "f8"),
        ("current_max_ma", "f8"),
        ("vent_ma", "f8"),
        ("watchdog_ns", "i8"),
        ("echo_period_ns", "i8"),
        ("echo_phase_ns", "i8"),
        ("analog_period_ns", "i8"),
        ("analog_phase_ns", "i8"),
        ("inclinometer_phase_ns", "i8"),
        ("clock_error", "f8"),  # of the inclinometer, relative
        ("inclinometer_lags", "u1"),  # its filter delays; 0 in the ideal layer
        ("driver_frame_ns", "i8"),
        ("analog_frame_ns", "i8"),
        ("command_delay_ns", "i8"),
        ("measurement_delay_ns", "i8"),
        ("truth_period_ns", "i8"),
    ]
)
FAULT = record_dtype([("kind", "i8"), ("on_ns", "i8"), ("off_ns", "i8"), ("magnitude", "f8")])
LOAD = record_dtype([("kind", "i8"), ("on_ns", "i8"), ("off_ns", "i8"), ("magnitude", "f8"), ("angle_deg", "f8")])
PLANT = record_dtype(
    [
        ("mechanics", MECHANICS),
        ("air", AIR),
        ("electrical", ELECTRICAL),
        ("loads", LOAD, (MAX_LOADS,)),
        ("faults", FAULT, (MAX_FAULTS,)),
        ("dump_m2", "f8"),  # opening of the dump valve without power; 0 where there is none
        ("seed", "i8"),
        ("step_ns", "i8"),
        ("n_states", "i8"),
        ("rig", "u1"),  # 1: spool, play, tube, heat, droop are on
    ]
)

# What the actuator remembers, and what hangs on it.
MEMORY = record_dtype(
    [
        ("angle_deg", "f8"),  # at which the stops were brought up to date
        ("stop", "f8", (N_STOPS,)),  # deg
        ("payload_deg_s2", "f8"),
        ("inertia", "f8"),  # 1 + the payload's share
        ("contact_1_s2", "f8"),
        ("contact_deg", "f8"),
    ]
)
FRAME = record_dtype([("end_ns", "i8"), ("due_ns", "i8"), ("charge", "i8"), ("exhaust", "i8"), ("output", "i8"), ("seq", "i8")])
DRIVER = record_dtype(
    [
        ("state", "i8"),  # ValveStatus DRIVER_OK or DRIVER_WATCHDOG
        ("seq", "i8"),
        ("accepted", "i8"),
        ("refused", "i8"),  # frames that found the queue full
        ("command_end_ns", "i8"),
        ("command_applied_ns", "i8"),
        ("watchdog_at_ns", "i8"),
        ("head", "i8"),
        ("waiting", "i8"),
        ("queue", FRAME, (QUEUE,)),
    ]
)
INCLINOMETER = record_dtype(
    [
        ("period_ns", "i8"),  # by its own clock; 0: it sends nothing
        ("wire_ns", "i8"),  # of all its packets of one sample
        ("content", "i8"),
        ("lag_s", "f8"),
        ("angle_deg", "f8"),  # after its filter
        ("rate_deg_s", "f8"),
    ]
)
# What is broken now; see `plant.faults`.
BROKEN = record_dtype(
    [
        ("chamber_bias_kpa", "f8"),
        ("angle_bias_deg", "f8"),
        ("rate_bias_deg_s", "f8"),
        ("noise", "f8"),  # times the sensors' own, besides it
        ("supply_lost", "f8"),  # part of the supply pressure
        ("burst_m2", "f8"),  # an opening beside the leak
        ("charge_leak_m2", "f8"),  # an opening beside the charge valve
        ("chamber_stuck", "u1"),
        ("analog_silent", "u1"),
        ("angle_stuck", "u1"),
        ("inclinometer_silent", "u1"),
        ("commands_lost", "u1"),
        ("driver_silent", "u1"),
        ("charge_stuck", "u1"),
        ("exhaust_stuck", "u1"),
        ("power_lost", "u1"),
    ]
)
STATE = record_dtype(
    [
        ("start_ns", "i8"),
        ("t_ns", "i8"),  # to which the physics has been brought
        ("reached_ns", "i8"),  # before which nothing more happens
        ("steps", "i8"),
        ("x", "f8", (N_STATES,)),
        ("stage", "f8", (N_STATES,)),
        ("slope", "f8", (N_STATES,)),
        ("next", "f8", (N_STATES,)),
        ("push", "f8", (N_VALVES,)),  # what acts on each spool where the step began, in the last stage, m2/s2 of its area
        ("push_before", "f8", (N_VALVES,)),  # in the step's first stage
        ("push_middle", "f8", (N_VALVES,)),
        ("memory", MEMORY),
        ("command_charge_ma", "f8"),
        ("command_exhaust_ma", "f8"),
        ("coil_charge_ma", "f8"),
        ("coil_exhaust_ma", "f8"),
        ("play_charge_ma", "f8"),  # the currents as the spools feel them, behind the hysteresis
        ("play_exhaust_ma", "f8"),
        ("sensed_supply_kpa", "f8"),  # after the sensors' lag
        ("sensed_chamber_kpa", "f8"),
        ("driver", DRIVER),
        ("inclinometer", INCLINOMETER),
        ("next_echo_ns", "i8"),
        ("next_analog_ns", "i8"),
        ("next_inclinometer_ns", "i8"),
        ("next_truth_ns", "i8"),
        ("next_load_ns", "i8"),
        ("echoes", "i8"),
        ("analog_samples", "i8"),
        ("inclinometer_samples", "i8"),
        ("load_on", "u1", (MAX_LOADS,)),
        ("next_fault_ns", "i8"),
        ("fault_on", "u1", (MAX_FAULTS,)),
        ("broken", BROKEN),
        ("held_chamber", "i8"),  # the readings that a stuck sensor repeats, counts
        ("held_angle", "i8"),
        ("held_rate", "i8"),
        ("truth", message("PlantTruth").dtype),
    ]
)
# Something that leaves the simulated rig. A frame or packet is sampled at `sample_ns` and has arrived at `end_ns`.
EVENT = record_dtype(
    [("kind", "i8"), ("sample_ns", "i8"), ("end_ns", "i8"), ("raw", "i8", (4,)), ("value", "f8")],
)

MECHANICS_TYPE, AIR_TYPE, ELECTRICAL_TYPE = record_type(MECHANICS), record_type(AIR), record_type(ELECTRICAL)
SENSOR_TYPE, PLANT_TYPE, MEMORY_TYPE, STATE_TYPE = (
    record_type(SENSOR),
    record_type(PLANT),
    record_type(MEMORY),
    record_type(STATE),
)
EVENTS_TYPE = array_of(record_type(EVENT))
