"""A simulated excitation written as a recorder would, for tests that begin with a log."""

import numpy as np

from softloop.controller.config import ControllerConfig
from softloop.offline.closed_loop import simulate_run
from softloop.plant.config import PlantConfig
from softloop.wire.channels import CYCLE, INCLINATION, PRESSURE, key
from softloop.wire.mcap_layout import LogWriter, Origin
from softloop.wire.messages import CDR_HEADER, message


def excitation_log(path, rig="bench-a", seed=5):
    """A log of the [0, 1] Hz excitation of an ideal rig on the bench `rig`."""
    controller = ControllerConfig(law="pressure", trajectory="excitation_1hz", trajectory_seed=seed)
    cycles = simulate_run(controller, PlantConfig(layer="ideal", seed=seed)).cycles
    with path.open("wb") as file:
        origin = Origin(rig, 1_760_000_000_000_000_000, int(cycles["stamp_ns"][0]) - 10_000_000_000)
        writer = LogWriter(file, origin, {"bench.toml": f'name = "{rig}"\n'.encode()})
        for channel, records in (
            (PRESSURE, _sensor(cycles, PRESSURE)),
            (INCLINATION, _sensor(cycles, INCLINATION)),
            (CYCLE, cycles),
        ):
            kind = message(channel.message)
            for record in np.array(records, kind.dtype):
                writer.add(key(rig, channel), channel, CDR_HEADER + record.tobytes()[: kind.cdr_size])
        writer.finish()
    return path


def _sensor(cycles, channel):
    out = np.zeros(len(cycles), message(channel.message).dtype)
    for name in ("seq", "stamp_ns"):
        out[name] = cycles[f"{channel.name}_{name}"]
    values = ("supply_pressure_kpa", "chamber_pressure_kpa") if channel is PRESSURE else ("angle_deg", "rate_deg_s")
    for name in values:
        out[name] = cycles[name]
    return out
