"""Stand-ins for the processes of a rig: no physics, only what the launcher sees of them.

    toy_node.py node NAME BENCH --run-dir DIR --lifeline-fd N

What a process does wrong stands in DIR/toy.json: name -> one of
`dies`, `dies_armed`, `dies_once`, `faults`, `hangs_armed`, `mute`, `deaf`.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

from softloop.deploy.bench import load_bench
from softloop.wire.channels import ARM, COMMAND, CYCLE, PRESSURE, REQUEST, STATUS, VALVES
from softloop.wire.errors import Unavailable
from softloop.wire.messages import constant, message
from softloop.wire.shell import run_process

DISARMED, ARMED, FAULT = (constant("ValveStatus", f"GATE_{s}") for s in ("DISARMED", "ARMED", "FAULT"))
STALE = constant("ValveStatus", "REASON_SENSOR_STALE")
PASS, CLOSED = (constant("ValveStatus", f"OUTPUT_{s}") for s in ("PASS", "CLOSED"))
TRAJECTORY_S = 0.5


def main():
    _, _, name, bench_file, _, run_dir, _, fd = sys.argv
    run_dir = Path(run_dir)
    wrong = json.loads((run_dir / "toy.json").read_text()).get(name, "")
    bench = load_bench(Path(bench_file), run_dir)

    def body(context):
        if wrong == "dies":
            raise Unavailable("the cable is out")
        if wrong == "deaf":
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if wrong == "mute":
            context.stop.wait(30)
            return
        loop(name, wrong, context)

    return run_process(name, body, bench=bench.name, zenoh=bench.zenoh, host=bench.host, run_dir=run_dir,
                       lifeline_fd=int(fd), realtime=False)  # fmt: skip


def loop(name, wrong, context):
    toy = {"valves": Gate, "controller": Controller, "pressures": Pressures}.get(name, Idle)(context, wrong)
    context.enter_loop()
    while not context.stop or wrong == "deaf":
        toy.step()
        time.sleep(0.01)


class Idle:
    def __init__(self, context, wrong):
        self.wire, self.clock, self.wrong = context.wire, context.clock, wrong
        self.valves = self.wire.latest(VALVES)
        self.status = self.wire.publisher(STATUS)
        self.mark = context.run_dir / "died_once"
        self.armed_ns = 0
        self.seq = 0

    def step(self):
        self.seq += 1
        payload = self.valves.take()
        if payload and message("ValveStatus").unpack(payload).gate == ARMED and not self.armed_ns:
            self.armed_ns = self.clock.now_ns()
        if self.armed_ns and self.wrong == "dies_armed":
            os._exit(7)
        if self.armed_ns and self.wrong == "dies_once" and not self.mark.exists():
            self.mark.touch()
            os._exit(7)


class Gate(Idle):
    def __init__(self, context, wrong):
        super().__init__(context, wrong)
        self.put = self.wire.publisher(VALVES)
        self.requests = self.wire.inbox(REQUEST, ARM)
        self.asked = context.run_dir / "asked"
        self.gate = DISARMED
        self.reason = self.armed_steps = 0

    def step(self):
        super().step()
        for _, payload in self.requests.take_all():
            action = message("GateRequest").unpack(payload).action
            self.gate = {0: DISARMED, 1: ARMED, 2: FAULT}[action]
            self.asked.write_text({0: "disarm", 1: "arm", 2: "stop"}[action])
        if self.gate == ARMED and self.wrong == "faults":
            self.gate, self.reason = FAULT, STALE
        kind = message("ValveStatus")
        output = PASS if self.gate == ARMED else CLOSED
        status = kind.make(seq=self.seq, stamp_ns=self.clock.now_ns(), gate=self.gate, reason=self.reason, output=output)
        self.put(kind.pack(status))
        self.armed_steps += self.gate == ARMED
        if self.armed_steps > 20 and self.wrong == "hangs_armed":
            os.kill(os.getpid(), signal.SIGSTOP)


class Pressures(Idle):
    def __init__(self, context, wrong):
        super().__init__(context, wrong)
        self.put = self.wire.publisher(PRESSURE)
        self.commands = self.wire.latest(COMMAND)
        self.chamber_kpa = 0.0

    def step(self):
        super().step()
        kind = message("PressureSample")
        self.put(kind.pack(kind.make(seq=self.seq, stamp_ns=self.clock.now_ns(), chamber_pressure_kpa=self.chamber_kpa)))


class Controller(Idle):
    def __init__(self, context, wrong):
        super().__init__(context, wrong)
        self.put = self.wire.publisher(CYCLE)

    def step(self):
        super().step()
        at_s = (self.clock.now_ns() - self.armed_ns) * 1e-9 if self.armed_ns else 0.0
        phase = 0 if not self.armed_ns else 3 if at_s > TRAJECTORY_S and self.wrong != "endless" else 2
        kind = message("CycleRecord")
        self.put(kind.pack(kind.make(seq=self.seq, stamp_ns=self.clock.now_ns(), phase=phase, trajectory_ns=int(at_s * 1e9))))


if __name__ == "__main__":
    sys.exit(main())
