"""Real sessions: what a control input, an inbox and a publisher do, directly and through the router."""

import threading
import time

import pytest
import zenoh

from softloop.wire.channels import CHANNELS, COMMAND, EVENT, PRESSURE, channel_of_key, key
from softloop.wire.config import ZenohConfig
from softloop.wire.errors import Unavailable
from softloop.wire.messages import message
from softloop.wire.session import Wire, open_meeting, open_router, open_session, open_wire
from softloop.wire.zenoh_settings import make_config
from tests.wire.rendezvous import meeting, short_folder, two_wires

PATIENCE_S = 10.0


def until(condition, timeout_s=PATIENCE_S):
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.005)
    raise AssertionError("it did not happen in time")


def sample(seq):
    return message("PressureSample").pack(message("PressureSample").make(seq=seq))


def send_until_seen(put, take):
    def attempt():
        put(sample(1))
        return take()

    return until(attempt)


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_a_control_input_holds_the_newest_sample_and_nothing_older(mode):
    with two_wires(mode) as (a, b):
        latest = b.latest(PRESSURE)
        put = a.publisher(PRESSURE)
        send_until_seen(put, latest.take)
        for seq in range(2, 50):
            put(sample(seq))
        seen = []
        until(
            lambda: ((p := latest.take()) and seen.append(message("PressureSample").unpack(p).seq)) or (seen and seen[-1] == 49)
        )
        assert seen == sorted(seen)
        assert latest.take() is None


def test_an_inbox_keeps_order_wakes_and_counts_what_it_dropped():
    with two_wires() as (a, b):
        inbox = b.inbox(EVENT)
        put = a.publisher(EVENT)
        kind = message("Event")
        until(lambda: put(kind.pack(kind.make(seq=1))) or inbox.take(0.05))
        inbox.take_all()
        threading.Timer(0.2, lambda: [put(kind.pack(kind.make(seq=s))) for s in (2, 3, 4)]).start()
        start = time.monotonic()
        taken = [inbox.take(PATIENCE_S) for _ in range(3)]
        assert time.monotonic() - start > 0.1
        late = [kind.unpack(p).seq for _, p in taken if kind.unpack(p).seq > 1]
        assert late == sorted(late)
        assert inbox.take(0.01) is None
        assert inbox.dropped == 0


def test_processes_are_seen_alive_and_gone():
    with meeting() as config, open_wire(config, "test", "watcher") as watcher:
        with open_wire(config, "test", "valves") as valves:
            valves.declare_alive()
            until(lambda: watcher.processes_alive() == {"valves"})
        until(lambda: watcher.processes_alive() == set())


def test_an_address_in_use_and_a_missing_folder_are_one_line():
    with meeting() as config, pytest.raises(Unavailable, match="in use"):
        open_router(config, "test")
    with pytest.raises(Unavailable, match="no folder"):
        open_router(ZenohConfig(endpoint="unixsock-stream//nowhere/at/all.sock"), "test")
    with pytest.raises(Unavailable, match="at most 70 characters"):
        open_router(ZenohConfig(endpoint="unixsock-stream//tmp/" + "x" * 80), "test")


def test_endpoints_off_this_machine_are_refused():
    with pytest.raises(ValueError, match="must begin with one of"):
        ZenohConfig(endpoint="tcp/192.168.1.7:7447")


def test_guests_meet_without_a_router_and_the_first_may_leave():
    with short_folder() as folder:
        endpoint = f"unixsock-stream/{folder}/meet.sock"
        first = open_meeting("test", endpoint)
        with open_meeting("test", endpoint) as second, open_meeting("test", endpoint) as third:
            b, c = Wire(second, "test", "b"), Wire(third, "test", "c")
            latest = c.latest(PRESSURE)
            send_until_seen(b.publisher(PRESSURE), latest.take)
            first.close()
            send_until_seen(b.publisher(PRESSURE), latest.take)


def test_nothing_is_left_to_defaults_that_reach_beyond_this_machine():
    config = make_config("peer", ["tcp/127.0.0.1:0"], [], 500)
    assert config.get_json("scouting/multicast/enabled") == "false"
    assert config.get_json("transport/shared_memory/enabled") == "false"
    assert config.get_json("listen/endpoints") == '["tcp/127.0.0.1:0"]'


def test_a_stalled_reader_does_not_hold_a_publisher():
    """A callback that never returns stalls its whole link; putting must still cost next to nothing."""
    release = threading.Event()
    with two_wires() as (a, b):
        stalled = b.session.declare_subscriber(
            key("test", COMMAND), zenoh.handlers.Callback(lambda _: release.wait(30), indirect=False)
        )
        put = a.publisher(COMMAND)
        payload = bytes(60_000)
        longest = 0.0
        for _ in range(400):
            start = time.monotonic()
            put(payload)
            longest = max(longest, time.monotonic() - start)
        release.set()
        stalled.undeclare()
    assert longest < 1.0  # BLOCK would have waited 5 s and then closed the link


def test_keys_belong_to_channels():
    for channel in CHANNELS:
        assert channel_of_key("b", key("b", channel)) is channel
    assert channel_of_key("b", "softloop/b/can/can0/80").name == "can"
    assert channel_of_key("b", "softloop/c/command") is None
    assert channel_of_key("b", "softloop/b/alive/valves") is None


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_a_process_may_start_before_its_router_and_outlive_it(mode):
    with short_folder() as folder:
        config = ZenohConfig(mode=mode, endpoint=f"unixsock-stream/{folder}/meet.sock")
        opened = []
        opener = threading.Thread(target=lambda: opened.append(open_session(config, "test", "early")))
        opener.start()
        time.sleep(0.3)
        with open_router(config, "test") as router:
            opener.join(PATIENCE_S)
            wire = Wire(opened[0], "test", "early")
            wire.declare_alive()
            until(lambda: Wire(router, "test", "launcher").processes_alive(0.1) == {"early"})
        time.sleep(0.3)
        with open_router(config, "test") as router:
            until(lambda: Wire(router, "test", "launcher").processes_alive(0.1) == {"early"})
        opened[0].close()
