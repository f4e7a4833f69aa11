"""Logs of a controller that ran on made-up inputs, written as the recorder writes them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import synthetic
import tomlkit

from softloop.controller.config import ControllerConfig
from softloop.controller.records import GATE_ARMED
from softloop.controller.setup import PERIOD_NS, Controller, build
from softloop.dynamics.parameters import shipped
from softloop.wire.channels import key
from softloop.wire.mcap_layout import LogWriter, versions
from softloop.wire.messages import message

MS = 1_000_000
START_NS = synthetic.START_CLOCK_NS + 100 * MS
APPROACH_S = 0.3
CONFIGS = {
    "pid": ControllerConfig(law="pid", trajectory="t1", approach_s=APPROACH_S),
    "arc": ControllerConfig(law="arc", trajectory="t2", approach_s=APPROACH_S),
    "pressure": ControllerConfig(law="pressure", trajectory="excitation_1hz", approach_s=APPROACH_S),
}
Made = list[tuple[str, bytes]]  # channel name and payload, in the order of the log


def made_run(config: ControllerConfig, ticks: int = 500, *, parameters: Any = None, start_ns: int = START_NS) -> Made:
    """A run with everything that happens at wall pace: a late gate, skipped ticks, stale inputs, a disarm and re-arming."""
    return list(_messages(build(config, parameters), ticks, start_ns))


def _messages(controller: Controller, ticks: int, start_ns: int) -> Iterator[tuple[str, bytes]]:
    noise = np.random.RandomState(5)
    inputs, tick, skipped = controller.inputs[0], 0, 0
    for _ in range(ticks):
        inputs.now_ns, inputs.tick, inputs.skipped = start_ns + tick * PERIOD_NS, tick, skipped
        for name, kind in (("pressure", "PressureSample"), ("inclination", "InclinationSample"), ("valves", "ValveStatus")):
            if _comes(name, tick, noise):
                _fill(inputs[name], name, inputs.now_ns, tick, noise)
                yield name, message(kind).pack_record(inputs[name])
        yield from _answer(controller.tick())
        skipped = int(noise.randint(1, 9)) if noise.uniform() < 0.02 else 0
        tick += 1 + skipped


def _comes(name: str, tick: int, noise: Any) -> bool:
    """Samples begin one after the other, one in ten is late, and the inclinometer is silent for longer than its budget."""
    if name == "inclination" and 250 <= tick < 262:
        return False
    return bool(tick >= {"pressure": 2, "inclination": 4, "valves": 0}[name] and noise.uniform() > 0.1)


def _fill(sample: Any, name: str, now_ns: int, tick: int, noise: Any) -> None:
    sample.seq += 1
    sample.stamp_ns = now_ns - 1_000_000 - noise.randint(4_000_000)
    if name == "valves":
        sample.gate = GATE_ARMED if 10 <= tick < 150 or tick >= 170 else 0
        sample.charge_current_ma, sample.exhaust_current_ma = noise.uniform(0, 220, 2)
        return
    sample.received_ns, sample.published_ns = sample.stamp_ns + 300_000, sample.stamp_ns + 400_000
    if name == "pressure":
        sample.supply_pressure_kpa, sample.chamber_pressure_kpa = 200.0 + noise.normal(), 40 + 30 * np.sin(0.03 * tick)
        sample.status = 1 if 210 <= tick < 213 else 0
    else:
        sample.angle_deg, sample.rate_deg_s = 70 + 25 * np.sin(0.02 * tick), 100 * np.cos(0.02 * tick) + noise.normal()


def _answer(cycle: Any) -> Iterator[tuple[str, bytes]]:
    """As the process writes them: the command, then the cycle record with the instants that only the process knows."""
    cycle.woken_ns, cycle.computed_ns, cycle.published_ns = (int(cycle.stamp_ns) + k for k in (60_000, 160_000, 220_000))
    same = ("seq", "tick", "pressure_stamp_ns", "inclination_stamp_ns", "chamber_pressure_kpa", "angle_deg")
    same += ("charge_current_ma", "exhaust_current_ma", "mode")
    command = message("ValveCommand")
    values = {name: cycle[name].item() for name in same}
    yield "command", command.pack(command.make(**values, stamp_ns=int(cycle.computed_ns), ready=int(cycle.inputs_valid)))
    yield "cycle", message("CycleRecord").pack_record(cycle)


def changed(made: Made, channel: str, **fields: Any) -> Made:
    """The same messages, with fields of one channel set; a value is a function of the message, None where it stays."""
    kind = message(synthetic.BY_NAME[channel].message)
    result: Made = []
    for name, payload in made:
        if name == channel:
            was = kind.unpack(payload)
            new = {f: v for f, make in fields.items() if (v := make(was)) is not None}
            payload = kind.pack(was._replace(**new))
        result.append((name, payload))
    return result


def without(made: Made, channel: str, leave_out: Any) -> Made:
    """The same messages but those of one channel for which `leave_out(message)` is true."""
    kind = message(synthetic.BY_NAME[channel].message)
    return [(n, p) for n, p in made if n != channel or not leave_out(kind.unpack(p))]


def write_run(
    folder: Path, made: Made, config: ControllerConfig, *, parameters: bytes | None = None, leave_out: tuple[str, ...] = ()
) -> Path:
    """A run's directory with its log; `leave_out` names attachments that it shall not have. Returns the log."""
    bench = {"name": synthetic.BENCH, "controller": config.model_dump(mode="json")}
    attachments = {
        "bench.toml": tomlkit.dumps(bench).encode(),
        "parameters.toml": parameters or shipped().read_bytes(),
        "versions.json": json.dumps(versions()).encode(),
    }
    folder.mkdir(exist_ok=True)
    with (folder / "run.mcap").open("wb") as file:
        writer = LogWriter(file, synthetic.ORIGIN, {n: a for n, a in attachments.items() if n not in leave_out})
        for name, payload in made:
            writer.add(key(synthetic.BENCH, synthetic.BY_NAME[name]), synthetic.BY_NAME[name], payload)
        writer.finish()
    return folder / "run.mcap"
