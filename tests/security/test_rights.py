"""The table of rights, and the rules that follow from it."""

from pathlib import Path

import zenoh

from softloop.deploy.bench import PROCESS_NAMES
from softloop.devices.protocols import can_frames
from softloop.wire import rights as r
from softloop.wire.channels import ARM, CHANNELS, COMMAND, FAULT, REQUEST, VALVES, can_key, key
from softloop.wire.fault_config import ZENOH_TARGETS

PEOPLE = {"operators": ["ann"], "guests": ["gus"]}
EVERYBODY = [*r.RIGHTS, "ann", "gus", "nobody"]


def who_may_put(part):
    return {one for one in EVERYBODY if r.rights_of(one, **PEOPLE).may_put(part)} - {r.ROUTER}


def test_the_sentences_of_the_documentation():
    assert who_may_put(COMMAND.name) == {"controller"}
    assert who_may_put(f"can/can0/{can_frames.VALVE_COMMAND_ID:x}") == {"valves"}
    assert who_may_put(ARM.name) == {"launcher", "ann"}
    assert who_may_put(REQUEST.name) == {"launcher", "follower", "monitor", "ann", "gus"}
    assert who_may_put(VALVES.name) == {"valves"}
    assert {one for one in EVERYBODY if r.rights_of(one, **PEOPLE).may_ask(FAULT.name)} - {r.ROUTER} == {"ann"}


def test_each_measured_or_commanded_channel_has_one_source():
    for channel, process in ZENOH_TARGETS.items():
        assert who_may_put(channel) == {process}
    assert who_may_put("truth") == {"plant"}
    assert who_may_put("cycle") == {"controller"}


def test_frames_of_the_dbc_have_the_senders_of_the_dbc():
    assert f"can/*/{can_frames.VALVE_STATUS_ID:x}" == r.DRIVER_FRAME
    assert f"can/*/{can_frames.ANALOG_INPUTS_ID:x}" == r.ANALOG_FRAME
    assert who_may_put(f"can/can0/{can_frames.VALVE_STATUS_ID:x}") == {"plant", "valves"}  # the gate copies it for the log
    assert who_may_put(f"can/can0/{can_frames.ANALOG_INPUTS_ID:x}") == {"plant", "valves", "pressures"}


def test_the_table_knows_every_process_and_whoever_it_does_not_know_may_nothing():
    assert set(r.RIGHTS) == {*PROCESS_NAMES, "launcher", "follower", "router"}
    assert r.rights_of("nobody", **PEOPLE) == r.Rights()
    assert r.rights_of("ann", [], []) == r.Rights()


def test_every_part_of_the_table_is_a_channel_there_is():
    known = {channel.name for channel in (*CHANNELS, FAULT)} | {r.ALL, r.BUSES, r.FRAMES, r.DRIVER_FRAME, r.ANALOG_FRAME}
    for one in (*r.RIGHTS.values(), r.OPERATOR, r.GUEST):
        assert {*one.puts, *one.hears, *one.asks, *one.answers} <= known


def permitted(rules, subject, flow, message, full_key):
    """What Zenoh makes of the rules, as its documentation says it: deny before allow, and a rule holds what its keys include."""
    own = {rule for policy in rules["policies"] if subject in policy["subjects"] for rule in policy["rules"]}
    wanted = zenoh.KeyExpr(full_key)
    found = {
        rule["permission"]
        for rule in rules["rules"]
        if rule["id"] in own
        and flow in rule["flows"]
        and message in rule["messages"]
        and any(zenoh.KeyExpr(one).includes(wanted) for one in rule["key_exprs"])
    }
    return found == {"allow"}


def test_the_rules_say_what_the_table_says():
    rules = r.access_control("b", **PEOPLE)
    assert rules["default_permission"] == "deny"
    keys = {c.name: key("b", c) for c in (*CHANNELS, FAULT)} | {
        f"can/can0/{n:x}": can_key("b", "can0", n) for n in (0x80, 0x90, 0x100)
    }
    for one in [*r.RIGHTS, "ann", "gus"]:
        has = r.rights_of(one, **PEOPLE)
        for part, full in keys.items():
            assert permitted(rules, one, "ingress", "put", full) == has.may_put(part), (one, part)
            assert permitted(rules, one, "egress", "put", full) == has.may_hear(part), (one, part)
            assert permitted(rules, one, "ingress", "declare_subscriber", full) == has.may_hear(part), (one, part)
            assert permitted(rules, one, "ingress", "query", full) == has.may_ask(part), (one, part)


def test_the_rules_are_of_one_bench_and_of_ones_own_name():
    rules = r.access_control("b", **PEOPLE)
    for one in EVERYBODY[:-1]:
        for message in ("put", "delete", "declare_subscriber", "query", "declare_queryable", "reply", "liveliness_token"):
            for wide in ("**", "softloop/**", "softloop/c/command", "softloop/*/command", "softloop-pace/c/tick/plant"):
                assert not permitted(rules, one, "ingress", message, wide)
        assert not permitted(rules, one, "ingress", "delete", "softloop/b/command")
    assert permitted(rules, "plant", "ingress", "liveliness_token", "softloop/b/alive/plant")
    assert not permitted(rules, "plant", "ingress", "liveliness_token", "softloop/b/alive/valves")
    assert permitted(rules, "plant", "ingress", "put", "softloop-pace/b/tick/plant")
    assert not permitted(rules, "valves", "ingress", "put", "softloop-pace/b/tick/plant")
    assert [s["cert_common_names"] for s in rules["subjects"] if s["id"] == "ann"] == [["b.ann"]]


def test_the_documentation_shows_the_table():
    """docs/security.md has a row for each identity; who puts what stands in it."""
    page = Path(__file__).resolve().parents[2].joinpath("docs", "security.md").read_text()
    for one in [*r.RIGHTS, "operators", "guests"]:
        assert f"| `{one}`" in page
