"""Over QUIC samples go as datagrams, which are not sent again; all else goes as over TCP."""

import socket

import pytest
import zenoh

from softloop.deploy.zenohd import listens
from softloop.wire.channels import ARM, CHANNELS, COMMAND, CYCLE, EVENT, INCLINATION, PRESSURE, REQUEST, VALVES, key
from softloop.wire.config import ZenohConfig
from softloop.wire.session import Wire, open_router, open_wire
from softloop.wire.zenoh_settings import settings_of
from tests.security.secured import secured
from tests.wire.test_session import sample, send_until_seen, until

BEST_EFFORT, RELIABLE = zenoh.Reliability.BEST_EFFORT, zenoh.Reliability.RELIABLE


class Declared:
    """A session that notes how publishers are declared."""

    def __init__(self):
        self.reliability = {}

    def declare_publisher(self, full_key, *, reliability, **_):
        self.reliability[full_key] = reliability
        return type("Publisher", (), {"put": lambda *_: None})()


def declared(*, datagrams, exact=False):
    session = Declared()
    wire = Wire(session, "b", "test", datagrams=datagrams)
    wire.exact = exact
    for channel in CHANNELS:
        wire.publisher(channel)
    return {channel for channel in CHANNELS if session.reliability[key("b", channel)] == BEST_EFFORT}


def test_only_what_the_next_period_brings_again_may_be_lost():
    assert declared(datagrams=True) == {PRESSURE, INCLINATION, COMMAND, VALVES}
    assert not {ARM, REQUEST, EVENT, CYCLE} & declared(datagrams=True)


def test_over_tcp_and_at_lockstep_pace_nothing_may():
    assert declared(datagrams=False) == set()
    assert declared(datagrams=True, exact=True) == set()


def test_a_publisher_outside_the_channels_is_reliable():
    session = Declared()
    Wire(session, "b", "test", datagrams=True).declare_publisher("any", realtime=True)
    assert session.reliability == {"any": RELIABLE}


@pytest.mark.parametrize(
    ("endpoint", "told"),
    [("tls/10.0.0.1:7447", "tls/10.0.0.1:7447"), ("quic/10.0.0.1:7447", "quic/10.0.0.1:7447?mixed_rel=1")],
)
def test_zenoh_is_told_that_a_link_carries_both(endpoint, told):
    settings = settings_of("peer", [endpoint], [endpoint], 5000)
    assert settings["listen/endpoints"] == settings["connect/endpoints"] == [told]


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_samples_and_words_pass_a_real_link(mode):
    with secured(mode, over="quic") as at, open_router(at.bench.zenoh, at.bench.name):
        assert ZenohConfig.model_validate(at.bench.zenoh).datagrams
        with (
            open_wire(at.bench.zenoh, at.bench.name, "pressures") as a,
            open_wire(at.bench.zenoh, at.bench.name, "recorder") as b,
        ):
            for wire in (a, b):
                wire.settle(lambda: False)
            samples, words = b.inbox(PRESSURE), b.inbox(EVENT)
            heard = send_until_seen(a.publisher(PRESSURE), lambda: samples.take(0.05))
            assert heard == (key(at.bench.name, PRESSURE), sample(1))
            put_word = a.publisher(EVENT)
            until(lambda: put_word(b"word") or words.take(0.05))


def test_a_udp_port_that_is_somebodys_is_known():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        assert listens(f"quic/127.0.0.1:{port}")
    assert not listens(f"quic/127.0.0.1:{port}")
