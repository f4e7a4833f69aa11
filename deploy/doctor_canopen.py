"""What the doctor says of a CANopen node that drives the valves: whether it would vent by itself. It is read, never written."""

from __future__ import annotations

from softloop.deploy.bench import Bench
from softloop.deploy.doctor_check import Check
from softloop.devices.canopen_node import talking
from softloop.devices.protocols.canopen_output import NodePlan, required_settings
from softloop.wire.can_port import CanPort
from softloop.wire.clock import Clock
from softloop.wire.errors import Lost, Unavailable

NAME = "valve driver's own vent"


def plan_on(bench: Bench, bus: str) -> NodePlan | None:
    """The node that drives the valves, when it is on this bus."""
    valves = bench.valves
    if valves is None or valves.can != bus or valves.node is None:
        return None
    return valves.node.plan(valves.vent_current_ma)


def own_vent(plan: NodePlan, port: CanPort, clock: Clock) -> Check:
    """Deadlines, error modes and error values as the node holds them, against what the gate needs of it."""
    settings = required_settings(plan)
    try:
        with talking(port, plan.node_id, clock) as talk:
            wrong = talk.wrong(settings)
    except (Lost, Unavailable) as error:
        return Check(NAME, "fail", str(error), "its power, node_id in the bench file, the bit rate of all")
    return judge_settings(plan, len(settings), wrong)


def judge_settings(plan: NodePlan, count: int, wrong: list[str]) -> Check:
    """The verdict on the settings that are wrong, a line for each."""
    measured = {"settings": count, "wrong": len(wrong)}
    if wrong:
        do = "do not run: without these it holds its last currents when the gate dies; `softloop canopen configure BENCH.toml`"
        return Check(NAME, "fail", "\n".join([f"{len(wrong)} of {count} settings are wrong", *wrong]), do, measured)
    charge, exhaust = plan.error_counts
    found = (
        f"node {plan.node_id}: {count} settings read back; without a set point for {plan.deadline_ms} ms, or the gate's "
        f"heartbeat for {plan.gate_heartbeat_ms} ms, set points {charge} (charge) and {exhaust} (exhaust, {plan.vent_ma:g} mA)"
    )
    return Check(NAME, "pass", found, "", measured)
