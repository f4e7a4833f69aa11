"""An emulated bus among nodes of several sessions: who hears what and when, error states and back, strangers' bytes."""

import errno
import time
from types import SimpleNamespace

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softloop.wire.can_bits import frame_bits
from softloop.wire.can_config import CanConfig, open_port
from softloop.wire.can_errors import NodeState
from softloop.wire.can_frame import FLAG_ERROR, controller_of, make_frame
from softloop.wire.can_owner import BusOwner
from softloop.wire.channels import bus_key, can_key
from softloop.wire.messages import message
from softloop.wire.session import open_wire
from tests.wire.rendezvous import meeting

MS = 1_000_000
CONFIG = CanConfig(emulation={"restart_ms": 10.0})


@pytest.fixture(scope="module")
def wires():
    with meeting() as zenoh, open_wire(zenoh, "test", "plant") as held, open_wire(zenoh, "test", "valves") as other:
        for wire in (held, other):
            wire.settle(lambda: False)
        yield held, other


@pytest.fixture
def bus(wires):
    """The holder with a device of its own, and the gate's port."""
    held, other = wires
    clock = SimpleNamespace(now_ns=lambda: 0)
    owner = BusOwner(CONFIG, held, ("driver", "valves"))
    port = open_port(CONFIG, "can0", other, clock)
    yield SimpleNamespace(owner=owner, port=port, gate=owner.nodes["valves"], driver=owner.nodes["driver"])
    port.close()
    owner.close()


def taken(owner, count=1):
    """Frames that other sessions handed over, given to their nodes at their stamps."""
    frames = [owner.recv(5.0) for _ in range(count)]
    assert None not in frames
    return [owner.send(frame, frame.stamp_ns) for frame in frames]


def from_driver(bus, arbitration_id, at_ns, seq=1):
    bus.owner.send(make_frame(seq, at_ns, bus.driver, arbitration_id, bytes(8)), at_ns)


def test_what_is_handed_over_stands_on_nobodys_bus_before_its_end_and_the_lower_identifier_goes_first(bus):
    assert bus.port.send(0x100, b"\x12", 1000)
    from_driver(bus, 0x090, 1000)
    assert taken(bus.owner) == [True]
    first_ns = bus.owner.next_ns()
    assert first_ns == 1000 + 2000 * frame_bits(make_frame(1, 0, 1, 0x90, bytes(8)))
    assert bus.owner.run_until(first_ns - 1) == []
    assert bus.port.recv(0.05) is None
    got = bus.owner.run_until(5 * MS)
    assert [(d.frame.arbitration_id, d.node, d.own) for d in got] == [
        (0x90, bus.driver, True), (0x90, bus.gate, False), (0x100, bus.gate, True), (0x100, bus.driver, False),
    ]  # fmt: skip
    heard = bus.port.recv(5.0)
    assert (heard.arbitration_id, heard.stamp_ns, heard.node) == (0x90, first_ns, bus.driver)
    assert bus.port.recv(0.05) is None  # nobody hears itself


def test_a_node_off_the_bus_is_told_so_sends_and_hears_nothing_and_comes_back(bus):
    bus.owner.bus.disturbs = lambda frame, start_ns: frame.arbitration_id == 0x80
    assert bus.port.send(0x80, bytes(8), MS)
    assert taken(bus.owner) == [True]
    bus.owner.run_until(12 * MS)
    assert bus.owner.bus.state(bus.gate) == NodeState.BUS_OFF
    told = [bus.port.recv(5.0) for _ in range(3)]
    assert all(frame.flags & FLAG_ERROR and frame.node == controller_of(bus.gate) for frame in told)
    assert [frame.seq for frame in told] == [1, 2, 3]
    assert bus.port.bus_off
    assert bus.port.bus_offs == 1
    assert not bus.port.send(0x80, bytes(8), 12 * MS)
    assert (bus.port.unsent, bus.port.bus_offs) == (1, 1)
    with pytest.raises(can.CanOperationError) as refused:
        bus.port.bus.send(can.Message(arbitration_id=0x80))
    assert refused.value.error_code == errno.ENETDOWN
    from_driver(bus, 0x090, 13 * MS)
    bus.owner.run_until(14 * MS)
    assert bus.port.recv(0.1) is None
    bus.owner.bus.disturbs = lambda frame, start_ns: False
    bus.owner.run_until(60 * MS)
    assert bus.port.recv(5.0).flags & FLAG_ERROR
    assert not bus.port.bus_off
    assert bus.port.send(0x80, bytes(8), 61 * MS)
    assert taken(bus.owner) == [True]
    from_driver(bus, 0x090, 61 * MS, seq=2)
    assert [d.frame.arbitration_id for d in bus.owner.run_until(70 * MS) if d.own] == [0x80, 0x90]


def test_an_error_state_of_one_node_is_none_of_anothers(bus, wires):
    bus.owner.bus.disturbs = lambda frame, start_ns: True
    from_driver(bus, 0x090, MS)
    bus.owner.run_until(20 * MS)
    assert bus.owner.bus.state(bus.driver) == NodeState.BUS_OFF
    time.sleep(0.1)
    while (frame := bus.port.recv(0.0)) is not None:
        assert frame.node == controller_of(bus.gate)
    assert not bus.port.bus_off


def test_its_status_says_load_counters_and_waiting(bus):
    for k in range(3):
        from_driver(bus, 0x090 + k, MS, seq=k + 1)
    bus.owner.run_until(10 * MS)
    status = message("CanBusStatus").make(seq=1, **bus.owner.status(10 * MS))
    bits = [frame_bits(make_frame(k + 1, MS, bus.driver, 0x90 + k, bytes(8))) for k in range(3)]
    assert status.load == pytest.approx(sum(bits) * 2e-6)
    assert status.waited_max_ns == 2000 * sum(bits[:2])
    assert (status.frames, status.nodes, list(status.node[:2])) == (3, 2, [bus.driver, bus.gate])
    message("CanBusStatus").pack(status)


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_any_bytes_on_a_nodes_keys_harm_nothing(wires, data):
    held, other = wires
    owner = _owner_of(held)
    payload = data.draw(st.one_of(st.binary(max_size=80), st.builds(_packed, st.integers(0, 0x7FF), st.integers(0, 7))))
    other.session.put(bus_key("test", "fuzzed", data.draw(st.integers(0, 0x7FF))), payload)
    frame = owner.recv(0.002)
    if frame is not None:
        assert not frame.flags & FLAG_ERROR
        owner.send(frame, 0)
        owner.run_until(owner.next_ns())


def _packed(arbitration_id, flags):
    frame = message("CanFrame").make(seq=1, node=5, arbitration_id=arbitration_id, flags=flags, dlc=8)
    return message("CanFrame").pack(frame)


_OWNERS = {}


def _owner_of(wire):
    """One for all examples: what one leaves the next one meets."""
    if wire not in _OWNERS:
        _OWNERS[wire] = BusOwner(CONFIG.model_copy(update={"channel": "fuzzed"}), wire, ("driver",))
    return _OWNERS[wire]


def test_strangers_do_not_eat_the_memory(bus):
    sent = [bus.owner.send(make_frame(1, 0, 1000 + k, 0x300, b""), 0) for k in range(100)]
    assert sent.count(True) == 62
    assert bus.owner.malformed == 38
    assert can_key("test", "can0", 0x300) != bus_key("test", "can0", 0x300)
