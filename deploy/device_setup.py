"""`softloop wt931 configure` and `softloop canopen configure`: settings written to a device, kept by it, and read back."""

from __future__ import annotations

from pathlib import Path

from softloop.deploy.bench import Bench
from softloop.deploy.device_access import AtRest, bench_at_rest
from softloop.deploy.doctor_inclinometer import hear_samples
from softloop.devices.canopen_node import NodeTalk, talking
from softloop.devices.config import InclinometerConfig, sampler_bounds
from softloop.devices.inclinometer_setup import SerialSource, configure
from softloop.devices.protocols import wt931
from softloop.devices.protocols.canopen_output import NodePlan, required_settings
from softloop.wire.can_config import open_port
from softloop.wire.clock import Clock
from softloop.wire.errors import EXIT_NEGATIVE, EXIT_OK, BadConfig

LISTEN_S = 2.0


def configure_wt931(bench_file: Path, from_baud: int | None) -> int:
    """Write the bench file's settings to the inclinometer, read them back, and count what it then sends.

    Args:
        from_baud: at which it listens now; None for what the bench file says.

    Raises:
        BadConfig: the bench has no inclinometer, or no device has that baud rate.
        Unavailable, Lost: as `configure`; the bench is running.
    """
    with bench_at_rest(bench_file) as rest:
        config = _inclinometer(rest.bench, from_baud)
        held = configure(config, rest.clock)
        print(f"WT931 on {config.port} at {config.baud} baud: {', '.join(f'{name} {value}' for name, value in held.items())}")
        rate_hz = _rate(config, rest.clock)
    right = abs(rate_hz - config.rate_hz) <= config.rate_tolerance * config.rate_hz
    print(f"it sends {rate_hz:.0f} samples per second, asked for were {config.rate_hz}")
    if not right:
        print("re-power it and ask again; a slow line or another device on its port also loses samples")
    return EXIT_OK if right else EXIT_NEGATIVE


def _inclinometer(bench: Bench, from_baud: int | None) -> InclinometerConfig:
    if bench.inclinometer is None:
        raise BadConfig(f"bench '{bench.name}' has no table [inclinometer]")
    if from_baud is None:
        return bench.inclinometer
    if from_baud not in wt931.BAUD_CODES:
        raise BadConfig(f"--from-baud must be one of {', '.join(map(str, wt931.BAUD_CODES))} (got {from_baud})")
    return bench.inclinometer.model_copy(update={"configure_baud": from_baud})


def _rate(config: InclinometerConfig, clock: Clock) -> float:
    """Samples per second by their stamps; 0 for none."""
    source = SerialSource(config.port, config.baud)
    try:
        samples, _, _ = hear_samples(source, wt931.Sampler(sampler_bounds(config), config.baud), clock, LISTEN_S)
    finally:
        source.close()
    span_ns = samples[-1].stamp_ns - samples[0].stamp_ns if len(samples) > 1 else 0
    return (len(samples) - 1) * 1e9 / span_ns if span_ns else 0.0


def configure_canopen(bench_file: Path) -> int:
    """Write to the CANopen node that drives the valves what makes it vent by itself, let it keep that, and read it back.

    Raises:
        BadConfig: the bench's driver is no CANopen node.
        Unavailable, Lost: the bus is not there, the node does not answer, or refuses a setting; the bench is running.
    """
    with bench_at_rest(bench_file) as rest:
        plan = node_plan(rest.bench)
        settings = required_settings(plan)
        before, after = _written(rest, plan)
    print(f"CANopen node {plan.node_id}: {len(before)} of {len(settings)} settings were other than they must be")
    for line in after:
        print(f"still wrong: {line}")
    if after:
        return EXIT_NEGATIVE
    print("all are written, kept by the node over a loss of power, and read back")
    return EXIT_OK


def node_plan(bench: Bench) -> NodePlan:
    """The CANopen node of a bench. Raises BadConfig when its valves are driven by another device."""
    node = bench.valves.node if bench.valves is not None else None
    if bench.valves is None or node is None:
        raise BadConfig(f"bench '{bench.name}': key 'valves.driver': is no CANopen node")
    return node.plan(bench.valves.vent_current_ma)


def _written(rest: AtRest, plan: NodePlan) -> tuple[list[str], list[str]]:
    """What the node held otherwise before, and after."""
    assert rest.bench.valves is not None
    name = rest.bench.valves.can
    port = open_port(rest.bench.can[name].model_copy(update={"mirror": False}), name, rest.wire, rest.clock, [plan.sdo_answer_id])
    try:
        with talking(port, plan.node_id, rest.clock) as talk:
            return _write(talk, plan)
    finally:
        port.close()


def _write(talk: NodeTalk, plan: NodePlan) -> tuple[list[str], list[str]]:
    settings = required_settings(plan)
    before = talk.wrong(settings)
    talk.write(settings)
    talk.store()
    return before, talk.wrong(settings)
