"""Benches for runs at lockstep pace, with everything in them that has to come out the same."""

import subprocess
import sys
from contextlib import contextmanager

LAWS = ("arc", "arc_eso", "smc", "pid", "pid_eso", "pressure", "pressure_eso")

# Payload and contact come and go; sensors lie, freeze and fall silent for less than their budgets; frames to the driver are lost
# for longer than its watchdog waits, once for good; all while the controller tracks. Bit rates and clocks are not the defaults.
EVENTFUL = """
base = "{base}"
[pace]
mode = "lockstep"
software_latency_us = 730
[run]
settle_s = 0.3
duration_s = {seconds}
vent_timeout_s = 0.5
[can.can0]
bitrate = 250000
[plant]
layer = "{layer}"
seed = {seed}
rate_hz = 200
measurement_delay_ms = 0.4
command_delay_ms = 1.3
watchdog_ms = 12.0
[[plant.loads]]
kind = "payload"
on_s = 1.1
off_s = 2.3
size = 300.0
[[plant.loads]]
kind = "contact"
on_s = 1.6
off_s = 2.6
size = 40.0
angle_deg = 33.0
[[plant.faults]]
kind = "chamber_bias"
on_s = 0.9
off_s = 1.2
size = 2.5
[[plant.faults]]
kind = "angle_stuck"
on_s = 1.3
off_s = 1.33
[[plant.faults]]
kind = "inclinometer_silent"
on_s = 1.4
off_s = 1.412
[[plant.faults]]
kind = "analog_silent"
on_s = 1.5
off_s = 1.511
[[plant.faults]]
kind = "noise"
on_s = 1.7
off_s = 2.0
size = 3.0
[[plant.faults]]
kind = "commands_lost"
on_s = 2.101
off_s = 2.109
[[plant.faults]]
kind = "commands_lost"
on_s = {lost_s}
[controller]
law = "{law}"
trajectory = "{trajectory}"
approach_s = 0.8
[controller.actuation]
switch_ticks = 2
modes = "{modes}"
"""


def eventful(base, *, law="arc", layer="rig", seed=5, seconds=2.6):
    """The bench file's text without its name; `seconds` are armed, and shortly before their end the driver hears no more."""
    trajectory = {"pressure": "excitation_1hz", "pressure_eso": "excitation_1hz"}.get(law, "t2")
    modes = "latched" if law.endswith("_eso") else "flow"
    return EVENTFUL.format(
        base=base, law=law, layer=layer, seed=seed, seconds=seconds, trajectory=trajectory, modes=modes, lost_s=seconds + 0.2
    )  # fmt: skip


@contextmanager
def busy_cores(count=2):
    """Both cores kept busy by another load, ended when the block is left."""
    loads = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for load in loads:
            load.kill()
            load.wait()
