"""Faults asked of the running plant: what may be asked, what comes of it in the rig, and who is refused."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.plant.fault_request import KINDS, UNITS, FaultRequest, is_sized, pack_request, read_request, unpack_request
from softloop.plant.faults import FAULTS, SIZED
from softloop.plant.injection import obey
from softloop.plant.records import EVENT_FAULT, MAX_FAULTS
from softloop.wire.channels import FAULT
from softloop.wire.errors import BadConfig, SoftloopError, Unavailable
from softloop.wire.messages import CDR_HEADER, constant, message
from softloop.wire.pace import Pace
from softloop.wire.questions import ask
from tests.plant.rigs import MS, Rig, of_kind
from tests.plant.test_process import running

KIND = message("FaultRequest")
NUMBER = st.one_of(st.just(0.0), st.floats(-2000.0, 2000.0), st.floats(allow_nan=False, allow_infinity=False))


def outcome(make):
    """What `make()` gives, and the words of its refusal."""
    try:
        return make(), ""
    except SoftloopError as error:
        return None, str(error)


@given(
    st.sampled_from(["break", "mend"]),
    st.sampled_from([*KINDS, ""]),
    NUMBER,
    NUMBER,
)
def test_a_request_is_refused_in_one_line_or_comes_through_the_wire_as_it_was(action, kind, size, duration_s):
    asked = {"action": action, "kind": kind, "size": size, "duration_s": duration_s}
    request, refusal = outcome(lambda: read_request(asked))
    if request is None:
        assert refusal
        assert "\n" not in refusal
        return
    assert unpack_request(pack_request(request)) == request
    if action == "break":
        assert (request.size != 0.0) == (kind in SIZED)


@given(st.one_of(
    st.binary(max_size=40),
    st.binary(min_size=KIND.cdr_size, max_size=KIND.cdr_size).map(lambda body: CDR_HEADER + body),
    st.builds(
        lambda size, seconds, action, fault: KIND.pack(KIND.make(size=size, duration_s=seconds, action=action, fault=fault)),
        st.floats(), st.floats(), st.integers(0, 3), st.integers(0, 255),
    ),
))  # fmt: skip
def test_any_bytes_are_refused_in_one_line_or_are_a_request_that_the_plant_can_take(payload):
    request, refusal = outcome(lambda: unpack_request(payload))
    if request is None:
        assert refusal
        assert "\n" not in refusal
        return
    assert math.isfinite(request.size)
    assert request.duration_s >= 0.0
    assert unpack_request(pack_request(request)) == request


def test_kinds_and_units_are_those_of_the_plant():
    assert set(KINDS) <= set(FAULTS)
    assert {kind for kind in KINDS if is_sized(kind)} == set(SIZED)
    assert set(SIZED) <= set(UNITS)


@pytest.mark.parametrize(("asked", "words"), [
    ({"kind": "gremlins"}, "kind must be one of chamber_bias"), ({}, "kind must be one of"),
    ({"kind": "chamber_bias"}, "needs a size"), ({"kind": "power_loss", "size": 1.0}, "has no size"),
    ({"kind": "supply_loss", "size": 1.5}, "out of range"), ({"kind": "noise", "size": 1e9}, "less than or equal to 1000"),
    ({"kind": "angle_stuck", "duration_s": -1.0}, "greater than or equal to 0"),
    ({"kind": "angle_stuck", "now": True}, "unknown key 'now'"),
    ({"action": "mend", "size": 1.0}, "mend has no size"), ({"kind": "angle_stuck", "size": "big"}, "key 'size'"),
])  # fmt: skip
def test_nonsense_is_refused_by_name(asked, words):
    with pytest.raises(BadConfig, match=words):
        read_request(asked)


def faults_of(rig, to_ms):
    events = of_kind(rig.until(to_ms * MS), EVENT_FAULT)
    return [(int(e["sample_ns"]), int(e["raw"][0]), int(e["raw"][1]), float(e["value"])) for e in events]


def test_what_is_asked_comes_at_once_and_leaves_after_its_time():
    rig = Rig(layer="ideal", start_ns=7)
    rig.until(100 * MS)
    obey(rig.params, rig.state, FaultRequest(kind="chamber_bias", size=4.0, duration_s=0.05))
    number = FAULTS["chamber_bias"]
    assert faults_of(rig, 200) == [(100 * MS + 1, 1, number, 4.0), (150 * MS + 1, 0, number, 4.0)]


def test_mending_ends_what_stands_and_leaves_what_is_to_come():
    planned = [{"kind": "angle_stuck", "on_s": 0.3}, {"kind": "driver_silent", "on_s": 0.05}]
    rig = Rig(layer="ideal", faults=planned)
    rig.until(100 * MS)
    obey(rig.params, rig.state, FaultRequest(kind="power_loss"))
    faults_of(rig, 150)
    obey(rig.params, rig.state, FaultRequest(action="mend", kind="power_loss"))
    assert [(code, kind) for _, code, kind, _ in faults_of(rig, 200)] == [(0, FAULTS["power_loss"])]
    obey(rig.params, rig.state, FaultRequest(action="mend"))
    assert [(code, kind) for _, code, kind, _ in faults_of(rig, 250)] == [(0, FAULTS["driver_silent"])]
    with pytest.raises(BadConfig, match="nothing is broken"):
        obey(rig.params, rig.state, FaultRequest(action="mend"))
    assert [(code, kind) for _, code, kind, _ in faults_of(rig, 350)] == [(1, FAULTS["angle_stuck"])]


def test_places_are_used_again_and_when_all_are_taken_it_says_so():
    rig = Rig(layer="ideal")
    for i in range(MAX_FAULTS + 3):  # one after the other: a place is free again after its fault
        rig.until((10 + 10 * i) * MS)
        obey(rig.params, rig.state, FaultRequest(kind="angle_stuck", duration_s=0.002))
    rig.until(1000 * MS)
    for _ in range(MAX_FAULTS):
        obey(rig.params, rig.state, FaultRequest(kind="chamber_bias", size=0.1))
    with pytest.raises(BadConfig, match="16 faults"):
        obey(rig.params, rig.state, FaultRequest(kind="chamber_bias", size=0.1))
    rig.until(1010 * MS)
    assert rig.state.broken.chamber_bias_kpa == pytest.approx(0.1 * MAX_FAULTS)


def test_the_process_answers_and_says_what_came():
    with running(seed=1) as bench:
        wire = bench.wire
        ask(wire, FAULT, pack_request(FaultRequest(kind="hose_burst", size=0.5)), 5.0)
        ask(wire, FAULT, pack_request(FaultRequest(action="mend")), 5.0)
        with pytest.raises(BadConfig, match="nothing is broken"):
            ask(wire, FAULT, pack_request(FaultRequest(action="mend")), 5.0)
        with pytest.raises(BadConfig, match="CDR"):
            ask(wire, FAULT, b"nonsense", 5.0)
        bench.hold(0.0, 0.2)
        events = [e for e in bench.taken(bench.events, "Event") if e.kind == constant("Event", "KIND_FAULT")]
        assert [(e.code, e.reason, e.value) for e in events] == [(1, FAULTS["hose_burst"], 0.5), (0, FAULTS["hose_burst"], 0.5)]
        wire.bench = "elsewhere"
        with pytest.raises(Unavailable, match="nothing of bench 'elsewhere' answers"):
            ask(wire, FAULT, pack_request(FaultRequest(action="mend")), 5.0)
        wire.bench = "test"


def test_where_equal_runs_give_equal_bytes_it_is_refused(monkeypatch):
    monkeypatch.setattr(Pace, "exact", True)
    with running(seed=1) as bench, pytest.raises(BadConfig, match=r"at lockstep pace .* \[\[plant.faults\]\]"):
        ask(bench.wire, FAULT, pack_request(FaultRequest(kind="angle_stuck")), 5.0)
