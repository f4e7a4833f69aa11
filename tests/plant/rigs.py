"""Rigs for tests."""

import numpy as np

from softloop.plant.config import PlantConfig
from softloop.plant.electrical import accept_command, run_until
from softloop.plant.records import EVENT
from softloop.plant.setup import new_device, new_state, plant_record

MS = 1_000_000
FRAME_NS = 270_000


class Rig:
    """A simulated rig with its state, its device and all events so far."""

    def __init__(self, start_ns=0, **plant):
        self.config = PlantConfig.model_validate(plant)
        self.params = plant_record(self.config)
        self.device = new_device(self.config)
        self.state = new_state(self.params, self.device, start_ns)
        self.events = []
        self.truths = []
        self.seq = 0

    def command(self, charge_ma, exhaust_ma, end_ns):
        self.seq += 1
        return accept_command(self.params, self.state, end_ns, round(100 * charge_ma), round(100 * exhaust_ma), 1, self.seq)

    def until(self, to_ns, room=64):
        """Let all up to `to_ns` happen; the new events."""
        events, new = np.zeros(room, EVENT), []
        while self.state.reached_ns < to_ns:
            count = run_until(self.params, self.state, to_ns, events)
            for event in events[:count]:
                new.append(event.tobytes())
                if event["kind"] == 4:
                    self.truths.append(self.state.truth.tobytes())
        self.events += new
        return np.frombuffer(b"".join(new), EVENT)

    def hold(self, charge_ma, exhaust_ma, from_ns, to_ns):
        """A valve frame every 5 ms; all events meanwhile."""
        found = []
        for at_ns in range(from_ns, to_ns, 5 * MS):
            self.command(charge_ma, exhaust_ma, at_ns + FRAME_NS)
            found.append(self.until(min(at_ns + 5 * MS, to_ns)))
        return np.concatenate(found)


def of_kind(events, kind):
    return events[events["kind"] == kind]
