"""Who may do what on a secured bench: the one table, and the Zenoh access rules that follow from it.

An identity is a name with a certificate. On every node of a bench the same rules hold: what a neighbour sends is let in when
the table lets that neighbour send it, and it is sent what the table lets it hear. Whatever is not named is refused.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

from softloop.wire.channels import (
    ARM,
    CAN,
    CLOCK,
    COMMAND,
    CYCLE,
    EVENT,
    FAULT,
    HOST,
    HOSTS_ROOT,
    INCLINATION,
    PACE_ROOT,
    PRESSURE,
    REQUEST,
    ROOT,
    SHADOW,
    STATUS,
    TIME,
    TRUTH,
    VALVES,
)

# The processes of a rig, by their tables in the bench file, and who else is on the wires.
RECORDER, MONITOR, PLANT, GATE, PRESSURES, INCLINOMETER, CONTROLLER = (
    "recorder", "monitor", "plant", "valves", "pressures", "inclinometer", "controller",
)  # fmt: skip
FOLLOWING = "shadow"  # the simulated plant that follows a rig
LAUNCHER = "launcher"  # the one that leads, or the only one
FOLLOWER = "follower"  # the launcher of every other host, `launcher-<host>` on the wire
ROUTER = "router"  # whoever is the meeting point

DOCTOR_ROOT = "softloop-doctor"  # where `softloop doctor` measures a way there and back

ALL = "**"
BUSES = "buses/*/*"  # who is on a CAN bus
FRAMES = f"{CAN.name}/*/*"
# By arbitration id, the driver's answer and the analogue module; a test compares them with the DBC file.
DRIVER_FRAME, ANALOG_FRAME = (f"{CAN.name}/*/{arbitration_id:x}" for arbitration_id in (0x90, 0x100))


@dataclass(frozen=True)
class Rights:
    """What one identity may do, as key expressions below `softloop/<bench>/`.

    Attributes:
        puts: what it may publish on.
        hears: what it may subscribe to.
        asks: what it may put questions on.
        answers: on what it may answer them.
    """

    puts: tuple[str, ...] = ()
    hears: tuple[str, ...] = ()
    asks: tuple[str, ...] = ()
    answers: tuple[str, ...] = ()

    def may_put(self, part: str) -> bool:
        """Whether a channel may be published on. `part`: its key below the bench's, without wildcards."""
        return any(_matches(one, part) for one in self.puts)

    def may_hear(self, part: str) -> bool:
        """Whether a channel may be subscribed to."""
        return any(_matches(one, part) for one in self.hears)

    def may_ask(self, part: str) -> bool:
        """Whether a question may be put on a channel."""
        return any(_matches(one, part) for one in self.asks)


_TELL = (EVENT.name, STATUS.name)
_HEAR = (VALVES.name, CLOCK.name)  # every process: when the gate is armed (`[faults]`), and what time it is
_WATCH = (CYCLE.name, PRESSURE.name, STATUS.name, EVENT.name, *_HEAR)
_ON_BUS = {"asks": (BUSES,), "answers": (BUSES,)}

RIGHTS = {
    CONTROLLER: Rights(puts=(COMMAND.name, CYCLE.name, *_TELL), hears=(PRESSURE.name, INCLINATION.name, *_HEAR)),
    # All frames: it sends the valve frame, and copies the driver's and the bus's errors for the log.
    GATE: Rights(puts=(VALVES.name, FRAMES, *_TELL), hears=(COMMAND.name, REQUEST.name, ARM.name, FRAMES, *_HEAR), **_ON_BUS),
    # The analogue frame: the copy for the log, where the bus is none on Zenoh.
    PRESSURES: Rights(puts=(PRESSURE.name, ANALOG_FRAME, *_TELL), hears=(FRAMES, *_HEAR), **_ON_BUS),
    INCLINOMETER: Rights(puts=(INCLINATION.name, *_TELL), hears=_HEAR),
    PLANT: Rights(
        puts=(TRUTH.name, DRIVER_FRAME, ANALOG_FRAME, *_TELL),
        hears=(FRAMES, *_HEAR),
        asks=(BUSES,),
        answers=(BUSES, FAULT.name),
    ),
    RECORDER: Rights(puts=_TELL, hears=(ALL,)),
    MONITOR: Rights(puts=(REQUEST.name, *_TELL), hears=(CYCLE.name, *_HEAR)),
    FOLLOWING: Rights(puts=(SHADOW.name, *_TELL), hears=(PRESSURE.name, INCLINATION.name, *_HEAR)),
    LAUNCHER: Rights(puts=(REQUEST.name, ARM.name, EVENT.name, CLOCK.name), hears=_WATCH),
    FOLLOWER: Rights(puts=(REQUEST.name, EVENT.name, CLOCK.name), hears=_WATCH),
    ROUTER: Rights(puts=(ALL,), hears=(ALL,), asks=(ALL,), answers=(ALL,)),
}
# People and their programs. Whoever has an identity may stop the rig; arming, and breaking the simulated rig, is the operators'.
OPERATOR = Rights(puts=(REQUEST.name, ARM.name), hears=(ALL,), asks=(FAULT.name,))
GUEST = Rights(puts=(REQUEST.name,), hears=(ALL,))


def rights_of(identity: str, operators: Collection[str], guests: Collection[str]) -> Rights:
    """What an identity may do; one that the bench file does not name may do nothing."""
    if identity in RIGHTS:
        return RIGHTS[identity]
    if identity in operators:
        return OPERATOR
    return GUEST if identity in guests else Rights()


def common_name(bench: str, identity: str) -> str:
    """The name in an identity's certificate: it holds the bench's, so that benches on one router stay apart."""
    return f"{bench}.{identity}"


def access_control(bench: str, operators: Collection[str], guests: Collection[str]) -> dict[str, Any]:
    """Zenoh's `access_control` for every node of a bench: who is not named, and what is not named, is refused."""
    everybody = [*RIGHTS, *operators, *guests]
    rules: list[dict[str, Any]] = []
    policies = []
    for identity in everybody:
        own = _rules(bench, identity, rights_of(identity, operators, guests))
        rules += own
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [identity]})
    subjects = [{"id": one, "cert_common_names": [common_name(bench, one)]} for one in everybody]
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


def _rules(bench: str, identity: str, rights: Rights) -> list[dict[str, Any]]:
    """The rules for the links to one identity: ingress is what it sends, egress what it is sent."""
    head, pace = f"{ROOT}/{bench}", f"{PACE_ROOT}/{bench}"
    own, alive = _own_name(identity), f"{head}/alive/*"
    rules: list[dict[str, Any]] = []

    def rule(flow: str, messages: list[str], keys: Sequence[str]) -> None:
        if keys:
            name = f"{identity} {len(rules)}"
            rules.append({"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": list(keys)})

    def below(parts: Sequence[str]) -> list[str]:
        return [f"{head}/{part}" for part in parts]

    hears, answers, asks = below(rights.hears), below(rights.answers), below(rights.asks)
    words, tells_time, asks_time = _between_hosts(bench, identity)
    rule("ingress", ["put"], [*below(rights.puts), f"{pace}/*/{own}", *words])
    rule("ingress", ["declare_subscriber"], [*hears, f"{pace}/*/*", *words])
    rule("ingress", ["query"], [*asks, *asks_time])
    rule("ingress", ["declare_queryable", "reply"], [*answers, *tells_time])
    rule("ingress", ["liveliness_token"], [f"{head}/alive/{own}"])
    rule("ingress", ["liveliness_query", "declare_liveliness_subscriber"], [alive])
    rule("egress", ["put"], [*hears, f"{pace}/*/*", *words])
    rule("egress", ["query"], [*answers, *tells_time])
    rule("egress", ["reply"], [*asks, *asks_time])
    rule("egress", ["liveliness_token", "liveliness_query", "declare_liveliness_subscriber"], [alive])
    # Who listens, and who answers, is no secret among identities: a publisher is told of subscriptions wider than its key.
    everything = [f"{root}/{bench}/{ALL}" for root in (ROOT, PACE_ROOT, HOSTS_ROOT, DOCTOR_ROOT)]
    rule("egress", ["declare_subscriber", "declare_queryable"], everything)
    return rules


def _own_name(identity: str) -> str:
    """By which names an identity's process shows that it is alive."""
    return {ROUTER: "*", FOLLOWER: f"{LAUNCHER}-$*"}.get(identity, identity)


def _between_hosts(bench: str, identity: str) -> tuple[list[str], list[str], list[str]]:
    """Keys that are not below the bench's own: words that an identity says and hears, where it tells the time, where it asks."""
    words, time = [f"{HOSTS_ROOT}/{bench}/{HOST.name}/*"], [f"{HOSTS_ROOT}/{bench}/{TIME}"]
    doctor = [f"{DOCTOR_ROOT}/{bench}/*"]
    if identity == ROUTER:
        return [*words, *doctor], time, time
    if identity in (LAUNCHER, FOLLOWER):
        return words, time if identity == LAUNCHER else [], time
    return (doctor if identity not in RIGHTS else []), [], []


def _matches(expression: str, part: str) -> bool:
    """Whether one of this table's key expressions holds a key: `*` is one chunk, a lone `**` everything."""
    if expression == ALL:
        return True
    chunks, given = expression.split("/"), part.split("/")
    return len(chunks) == len(given) and all(chunk in ("*", one) for chunk, one in zip(chunks, given, strict=True))
