"""The one table of channels: key, message, rate, staleness budget, delivery, logged or not."""

from __future__ import annotations

from dataclasses import dataclass
from zlib import crc32

MS = 1_000_000

ROOT = "softloop"


@dataclass(frozen=True)
class Channel:
    """One channel of a bench.

    Attributes:
        name: last part of its key, `softloop/<bench>/<name>`.
        message: name of its `.msg` definition.
        rate_hz: how often it is published when all is well; 0 for "when something happens".
        staleness_ns: how old its newest sample may be before an input that needs it counts as lost; 0 for never.
        realtime: on the 5 ms path: sent with the highest priority, never waited for at wall pace.
        logged: the recorder keeps it.
    """

    name: str
    message: str
    rate_hz: float
    staleness_ns: int = 0
    realtime: bool = False
    logged: bool = True

    @property
    def sampled(self) -> bool:
        """On the 5 ms path and there again in the next period, so that one that is lost is better not sent again."""
        return self.staleness_ns > 0


PRESSURE = Channel("pressure", "PressureSample", 200.0, 20 * MS, realtime=True)
INCLINATION = Channel("inclination", "InclinationSample", 200.0, 30 * MS, realtime=True)
COMMAND = Channel("command", "ValveCommand", 200.0, 15 * MS, realtime=True)
VALVES = Channel("valves", "ValveStatus", 200.0, 50 * MS, realtime=True)
REQUEST = Channel("request", "GateRequest", 0.0)  # to disarm, stop, or go to FAULT: whoever has a right on the bench may ask
ARM = Channel("arm", "GateRequest", 0.0)  # to arm, and nothing else: a key of its own, so that access rules can tell
EVENT = Channel("event", "Event", 0.0)
CYCLE = Channel("cycle", "CycleRecord", 200.0)
TRUTH = Channel("truth", "PlantTruth", 200.0)
STATUS = Channel("status", "ProcessStatus", 1.0)
CAN_BUS = Channel("canbus", "CanBusStatus", 0.0)  # of each emulated CAN bus, ten times a second
CLOCK = Channel("clock", "ClockOffset", 10.0)  # with several hosts: from each but that of the controller
SHADOW = Channel("shadow", "ShadowDivergence", 20.0)  # where the bench has a [shadow]
CAN = Channel("can", "CanFrame", 600.0, realtime=True)  # key: can/<bus>/<arbitration id in hex>

CHANNELS = (PRESSURE, INCLINATION, COMMAND, VALVES, REQUEST, ARM, EVENT, CYCLE, TRUTH, STATUS, CAN_BUS, CLOCK, SHADOW, CAN)

# Asked for and answered, not published (`wire.questions`): a fault for the simulated rig, answered by the plant alone.
FAULT = Channel("fault", "FaultRequest", 0.0, logged=False)

# Lockstep pace alone, and on keys of their own, which nobody hears who does not ask for them. Of the priority of what they
# speak of, so that on a link neither overtakes the other.
PACE_ROOT = "softloop-pace"
TICK = Channel("tick", "Tick", 200.0, realtime=True, logged=False)
HELLO = Channel("hello", "Watermark", 0.0, realtime=True, logged=False)
WATERMARK = Channel("watermark", "Watermark", 200.0, realtime=True, logged=False)
END = Channel("end", "Watermark", 0.0, realtime=True, logged=False)

# What waits for an emulated CAN bus, and has not stood on it yet: nobody hears it but whoever holds the bus.
BUS_ROOT = "softloop-bus"

# Between the launchers of a bench's hosts, on keys of their own too: their words, and the question for the time.
HOSTS_ROOT = "softloop-hosts"
HOST = Channel("host", "HostStatus", 5.0, logged=False)
TIME = "time"


def key(bench: str, channel: Channel) -> str:
    """Zenoh key of a channel of a bench."""
    return f"{ROOT}/{bench}/{channel.name}"


def can_key(bench: str, bus: str, arbitration_id: int) -> str:
    """Zenoh key of a CAN frame, so that access rules can tell frames apart: `softloop/<bench>/can/<bus>/<id>`."""
    return f"{ROOT}/{bench}/{CAN.name}/{bus}/{arbitration_id:x}"


def bus_key(bench: str, bus: str, arbitration_id: int) -> str:
    """Key on which a node hands a frame to the emulated bus that is to carry it: `softloop-bus/<bench>/<bus>/<id>`."""
    return f"{BUS_ROOT}/{bench}/{bus}/{arbitration_id:x}"


def node_of(bench: str, process: str, bus: str) -> int:
    """The number of a process among a bus's senders where it has to be the same each time; not 0."""
    return crc32(f"{bench} {process} {bus}".encode()) + 1


def alive_key(bench: str, process: str) -> str:
    """Key of a process's liveliness token."""
    return f"{ROOT}/{bench}/alive/{process}"


def pace_key(bench: str, channel: Channel, process: str) -> str:
    """Key on which a process says at lockstep pace what `channel` carries: `softloop-pace/<bench>/<channel>/<process>`."""
    return f"{PACE_ROOT}/{bench}/{channel.name}/{process}"


def host_key(bench: str, host: str) -> str:
    """Key on which the launcher of a host speaks to the others: `softloop-hosts/<bench>/host/<host>`."""
    return f"{HOSTS_ROOT}/{bench}/{HOST.name}/{host}"


def time_key(bench: str) -> str:
    """Key on which the controller's host answers what its clock says: `softloop-hosts/<bench>/time`."""
    return f"{HOSTS_ROOT}/{bench}/{TIME}"


def channel_of_key(bench: str, full_key: str) -> Channel | None:
    """The channel a key belongs to, or None."""
    head = f"{ROOT}/{bench}/"
    if not full_key.startswith(head):
        return None
    name = full_key[len(head) :].split("/", 1)[0]
    return next((c for c in CHANNELS if c.name == name), None)
