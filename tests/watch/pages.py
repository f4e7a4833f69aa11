"""A page served in this process, and a gate that obeys, for tests."""

import threading
import time
from contextlib import contextmanager

from softloop.deploy.bench import load_bench
from softloop.deploy.page import hello_of
from softloop.deploy.rig_state import event_line
from softloop.deploy.watching import overview_of
from softloop.watch.config import PageConfig
from softloop.watch.page.app import Site
from softloop.watch.page.feed import Feed
from softloop.watch.page.requests import StopLine
from softloop.watch.page.server import serve
from softloop.wire.channels import ARM, REQUEST
from softloop.wire.messages import constant, message
from softloop.wire.shell import Stop
from tests.watch.benches import repeating

WAIT_S = 20.0
ACTIONS = {constant("GateRequest", f"ACTION_{a}"): a.lower() for a in ("ARM", "DISARM", "STOP")}
STATES = {"arm": constant("ValveStatus", "GATE_ARMED"), "disarm": 0, "stop": constant("ValveStatus", "GATE_FAULT")}
EMERGENCY = constant("ValveStatus", "REASON_EMERGENCY_STOP")


def until(condition, what="waited in vain"):
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.01)


@contextmanager
def served(bench_file, *, port=0, **site):
    """A page of a bench on a free port; gives its `Site` and address."""
    bench = load_bench(bench_file)
    feed = Feed(overview_of(bench), event_line, 600.0)
    made = Site(feed, StopLine(), hello_of(bench), **site)
    stop, address, failure = Stop(), [], []

    def run():
        try:
            serve(made, PageConfig(port=port), bench.zenoh, bench.name, stop, address.append)
        except Exception as error:  # noqa: BLE001 - shown where it matters, below
            failure.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        until(lambda: address or failure, "no address")
        assert not failure, failure
        yield made, address[0]
    finally:
        stop.set("test")
        thread.join(WAIT_S)
        assert not thread.is_alive()


class ToyRig:
    """Speaks on every channel that the page shows, 200 times a second, and obeys requests like a gate.

    Attributes:
        requests: (action, when it was heard on this machine's clock, s), in order.
        cycles: every cycle record that was sent.
    """

    def __init__(self, speaker):
        self.speaker = speaker
        self.inbox = speaker.wire.inbox(REQUEST, ARM)
        self.gate = 0
        self.requests, self.cycles = [], []
        self.used = set()

    def turn(self, i):
        for _, payload in self.inbox.take_all():
            self._obey(message("GateRequest").unpack(payload))
        now_ns = time.monotonic_ns()
        t = now_ns * 1e-9
        reference = 60.0 + 20.0 * ((t % 10.0) / 10.0)
        cycle = {"seq": i + 1, "tick": i, "stamp_ns": now_ns, "woken_ns": now_ns + 60_000 + (i * 7919) % 400_000}
        cycle |= {"angle_deg": reference + 0.25, "reference_deg": reference, "error_deg": 0.25, "phase": 2, "mode": 1 + i % 3}
        cycle |= {"chamber_pressure_kpa": 40.0 + i % 10, "desired_pressure_kpa": 42.0, "supply_pressure_kpa": 198.5}
        cycle |= {"charge_current_ma": 80.0, "exhaust_current_ma": 50.0, "trajectory_ns": i * 5_000_000, "adapting": 1}
        cycle |= {"pressure_age_ns": 3_400_000, "inclination_age_ns": 4_900_000}
        self.cycles.append(cycle)  # before it is sent: whoever has seen it finds it here
        self.speaker.say("cycle", **cycle, theta=tuple(float(k) for k in range(14)))
        reason = EMERGENCY if self.gate == STATES["stop"] else 0
        self.speaker.say("valves", seq=i + 1, stamp_ns=now_ns, gate=self.gate, output=int(self.gate == 1), reason=reason)
        for arbitration_id in (0x80, 0x90, 0x100):
            self.speaker.frame("can0", arbitration_id, seq=i + 1, dlc=8)
        if i % 100 == 0:
            self.speaker.say("status", seq=i, stamp_ns=now_ns, pid=4242, process=2, state=1, late_max_ns=800_000, cycles=i)

    def _obey(self, request):
        action = ACTIONS[request.action]
        self.requests.append((action, time.monotonic()))
        if (action, request.origin, request.seq) not in self.used:
            self.used.add((action, request.origin, request.seq))  # each channel is counted by itself
            latched = self.gate == STATES["stop"] and action == "disarm"
            if self.gate != STATES[action] and not latched:
                self.gate = STATES[action]
                self.speaker.say("event", stamp_ns=time.monotonic_ns(), source=1, kind=1, code=self.gate, reason=12)


@contextmanager
def toy_rig(speaker):
    rig = ToyRig(speaker)
    with repeating(rig.turn):
        yield rig
