"""One process of a bench: which module it is, which config it gets, and its life inside the process shell."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from softloop.deploy.bench import PROCESS_NAMES, Bench, load_bench, process_config
from softloop.deploy.hosts import host_of, leader, number_of, on_host
from softloop.wire.clock import Clock
from softloop.wire.errors import BadConfig
from softloop.wire.host_clock import HostClock
from softloop.wire.messages import constant
from softloop.wire.pace import Pace
from softloop.wire.schedule import make_schedule
from softloop.wire.session import Wire
from softloop.wire.shell import Context, Stop, run_process


@dataclass(frozen=True)
class Process:
    """One kind of process. Its name is that of its table in the bench file.

    Attributes:
        name: the process and its table.
        module: where its `run(config, context)` stands.
        realtime: it is on the 5 ms path and takes real-time priority where the machine grants it.
        source: the constant `SOURCE_*` of `Event.msg` by which it names itself in its `ProcessStatus`.
    """

    name: str
    module: str
    realtime: bool
    source: str


_KNOWN = (
    Process("recorder", "softloop.watch.recorder", False, "SOURCE_RECORDER"),
    Process("monitor", "softloop.watch.monitor", False, "SOURCE_MONITOR"),
    Process("shadow", "softloop.plant.shadow_process", False, "SOURCE_SHADOW"),
    Process("plant", "softloop.plant.process", True, "SOURCE_PLANT"),
    Process("valves", "softloop.devices.valves", True, "SOURCE_GATE"),
    Process("pressures", "softloop.devices.pressures", True, "SOURCE_PRESSURES"),
    Process("inclinometer", "softloop.devices.inclinometer", True, "SOURCE_INCLINOMETER"),
    Process("controller", "softloop.controller.process", True, "SOURCE_CONTROLLER"),
)
PROCESSES = tuple(sorted(_KNOWN, key=lambda process: PROCESS_NAMES.index(process.name)))
# Together in each group. The gate vents while the plant still runs, and the recorder sees all of it.
KEPT_PROCESSES = ("recorder", "monitor", "shadow")  # those that only listen: brought back when they die
WALL_PACE_ONLY = ("monitor",)  # its word would come at another tick each time; `softloop log invariants` says the same of a log
STOP_ORDER = (("controller",), ("valves",), ("pressures", "inclinometer", "plant", "monitor", "shadow"), ("recorder",))


def processes_of(bench: Bench) -> tuple[Process, ...]:
    """The processes whose tables stand in the bench; at lockstep pace without those that keep no step."""
    left_out = WALL_PACE_ONLY if bench.pace.mode == "lockstep" else ()
    return tuple(p for p in PROCESSES if getattr(bench, p.name) is not None and p.name not in left_out)


def find_process(bench: Bench, name: str) -> Process:
    """The process called `name`. Raises BadConfig when the bench has none."""
    here = processes_of(bench)
    found = next((p for p in here if p.name == name), None)
    if found is None:
        raise BadConfig(f"bench '{bench.name}' has no process '{name}'; it has: {', '.join(p.name for p in here) or 'none'}")
    return found


def run_node(name: str, bench_file: Path, run_dir: Path, lifeline_fd: int | None = None) -> int:
    """Be one process of a bench until asked to stop; returns its exit code.

    Raises:
        SoftloopError: the bench file is wrong, or has no such process.
    """
    bench = load_bench(bench_file, run_dir)
    process = find_process(bench, name)
    bench = on_host(bench, host_of(bench, name))

    def body(context: Context) -> None:
        _inject(bench, process, context)
        import_module(process.module).run(process_config(bench, name), context)

    return run_process(
        name,
        body,
        bench=bench.name,
        zenoh=bench.zenoh,
        host=bench.host,
        run_dir=run_dir,
        lifeline_fd=lifeline_fd,
        realtime=process.realtime,
        pace_of=lambda wire, stop: make_pace(bench, name, wire, stop),
    )


def _inject(bench: Bench, process: Process, context: Context) -> None:
    """Let the process hear and say what `[faults]` makes of it."""
    if not bench.faults.of_process(process.name):
        return
    from softloop.wire.faults import install, when_armed  # noqa: PLC0415 - no sound rig needs it

    armed_ns = when_armed(context.wire) if bench.pace.mode == "wall" else lambda: planned_arming_ns(bench)
    install(bench.faults, context, constant("Event", process.source), armed_ns)


def planned_arming_ns(bench: Bench) -> int:
    """Rig clock at which the gate is asked to arm at lockstep pace."""
    return make_schedule(bench.run.settle_s, 0.0, 0.0).arm_ns


def rig_clock(bench: Bench, host: str, wire: Wire, stop: Stop) -> Clock | None:
    """The clock at wall pace: None for the machine's own, else one that follows this host's launcher, once that has spoken."""
    if not host or host == leader(bench):
        return None
    clock = HostClock(number_of(bench, host))
    clock.listen(wire)
    clock.wait_known(lambda: bool(stop))
    return clock


def make_pace(bench: Bench, name: str, wire: Wire, stop: Stop) -> Pace:
    """How the process `name` keeps time on this bench."""
    if bench.pace.mode == "wall":
        return Pace(rig_clock(bench, host_of(bench, name), wire, stop))
    from softloop.wire.lockstep import Follower, Leader  # noqa: PLC0415 - no rig at wall pace needs it

    others = {p.name for p in processes_of(bench)} - {name}
    return (Leader if name == "plant" else Follower)(bench.pace, wire, stop, others)
