"""Mutants that no test can kill, each with the reason why it changes nothing that matters."""

JUSTIFIED = {
    "gate": {
        "arm_is_new: if state.requesters == REQUESTERS and (i == 0 or state.arm_heard_ns[i] < state.arm_heard_ns[place]): -> "
        "if state.requesters == REQUESTERS and (i == 0 or state.arm_heard_ns[i] <= state.arm_heard_ns[place]):": (
            "Of two who were heard at the same instant the other one is forgotten, and either may be: both are too old to arm."
        ),
        "change_state: if state.gate != before and state.gate != GATE_ARMED: -> if state.gate != before:": (
            "On arming, too, the venting would begin anew; but while armed nothing reads it, and every way out of ARMED sets "
            "both of its fields again."
        ),
        "vent_output: if state.venting == 1 and (empty or (given.now_ns - state.vent_since_ns >= config.vent_time_ns and "
        "(not high))): -> if empty or (given.now_ns - state.vent_since_ns >= config.vent_time_ns and (not high)):": (
            "The branch does nothing but end the venting: where there is none, it ends none."
        ),
    },
    "watchdog": {
        "accept_command: if driver.waiting > 0: -> if driver.waiting >= 0:": (
            "With an empty queue the place before is that of the frame applied last, whose due time the physics has reached; a "
            "frame is due at the later of its own due time and the time of the physics, so that nothing changes."
        ),
        "_apply_frame: events[n - 1].raw[0] = DRIVER_OK -> pass": (
            "DRIVER_OK is 0, and _write has just set the event's numbers to 0."
        ),
        "_apply_frame: events[n - 1].raw[0] = DRIVER_OK -> events[n - 1].raw[1] = DRIVER_OK": (
            "DRIVER_OK is 0, and _write has just set the event's numbers to 0."
        ),
    },
}
