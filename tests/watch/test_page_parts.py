"""The parts of the live page that need neither a server nor a browser."""

import asyncio
import json
import struct
import time
from collections import deque
from types import SimpleNamespace

import numpy as np
import pytest

from softloop.watch.config import PageConfig
from softloop.watch.overview import Overview
from softloop.watch.page import requests
from softloop.watch.page.access import Access, read_token
from softloop.watch.page.history import COLUMNS, History
from softloop.watch.page.requests import StopLine, ask
from softloop.watch.page.state import as_json, events_of, state_of
from softloop.wire.benchfile import load_model
from softloop.wire.channels import CYCLE, EVENT, VALVES, key
from softloop.wire.errors import BadConfig, BadFile
from softloop.wire.messages import message
from tests.watch.pages import until

START_NS = 10**12


def cycle(i, **values):
    return message("CycleRecord").make(
        seq=i + 1, stamp_ns=START_NS + 5_000_000 * i, angle_deg=0.1 * i, mode=i % 3, **{"phase": 2} | values
    )


def unpacked(data):
    rows, columns, base = struct.unpack_from("<IId", data)
    values = np.frombuffer(data, "<f4", offset=16).reshape(rows, columns).astype(float)
    values[:, 0] += base
    return values


def test_a_history_is_a_ring_that_many_read():
    history = History(100)
    history.append(cycle(i) for i in range(250))
    assert (history.first, history.head) == (150, 250)
    rows = history.rows(0, 1000)
    np.testing.assert_allclose(rows[:, 0], np.arange(150, 250) * 0.005)
    np.testing.assert_allclose(rows[:, COLUMNS.index("angle_deg")], 0.1 * np.arange(150, 250))
    assert history.rows(10, 20).shape == (0, len(COLUMNS))
    np.testing.assert_allclose(unpacked(history.packed(240, 250)), rows[-10:], rtol=1e-6)


def test_times_keep_their_microseconds_after_a_day():
    history = History(10)
    history.append([cycle(0)])
    history.append(cycle(17_280_000 + i) for i in range(3))
    times = unpacked(history.packed(1, 4))[:, 0]
    np.testing.assert_allclose(times, 86_400 + np.arange(3) * 0.005, atol=1e-6)


def test_a_rig_clock_that_goes_back_begins_a_new_history():
    history = History(10)
    history.append(cycle(i) for i in range(5))
    history.append([cycle(0), cycle(1)])
    assert (history.epoch, history.head) == (1, 2)
    assert history.rows(0, 2)[1, 0] == pytest.approx(0.005)


def test_while_the_controller_waits_nothing_is_asked():
    history = History(10)
    history.append([cycle(0, phase=0, reference_deg=0.0), cycle(1, phase=1, reference_deg=30.0)])
    reference = history.rows(0, 2)[:, COLUMNS.index("reference_deg")]
    assert np.isnan(reference[0])
    assert reference[1] == 30.0


def headers(**given):
    return {name.replace("_", "-"): value for name, value in given.items()}


@pytest.mark.parametrize(
    ("given", "refused"),
    [
        (headers(host="127.0.0.1:8420"), ""),
        (headers(host="localhost:8420", origin="http://localhost:8420"), ""),
        (headers(host="[::1]:8421", origin="http://[::1]:8420"), ""),
        (headers(host="rebound.example:8420"), "names of this machine"),
        (headers(), "names of this machine"),
        (headers(host="127.0.0.1:8420", origin="http://evil.example"), "another page"),
        (headers(host="127.0.0.1:8420", origin="http://127.0.0.1:9999"), "another page"),
        (headers(host="127.0.0.1:8420", origin="null"), "another page"),
        (headers(host="127.0.0.1:8420", origin="http://localhost:8420"), "another page"),
    ],
)
def test_on_loopback_no_other_page_may_use_this_one(given, refused):
    said = Access(frozenset({8420, 8421})).refusal(given, "")
    assert refused in said
    assert bool(said) == bool(refused)


def test_a_token_is_brought_by_address_or_cookie():
    access = Access(frozenset({443}), "a-long-enough-token", loopback=False)
    host = headers(host="rig.lab")
    assert "a token is needed" in access.refusal(host, "")
    assert "a token is needed" in access.refusal(host, "token=wrong")
    assert access.refusal(host, "token=a-long-enough-token") == ""
    assert access.refusal(host | {"cookie": "softloop_token=a-long-enough-token"}, "") == ""
    assert "another page" in access.refusal(host | {"origin": "https://evil.example"}, "token=a-long-enough-token")
    assert access.refusal(host | {"origin": "https://rig.lab"}, "token=a-long-enough-token") == ""


def test_tokens_have_a_length(tmp_path):
    file = tmp_path / "token"
    file.write_text("short\n")
    with pytest.raises(BadFile, match="at least 16"):
        read_token(file)
    with pytest.raises(BadFile, match="cannot be read"):
        read_token(tmp_path / "none")


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.7", "::", "rig.lab"])
def test_off_loopback_needs_tls_and_a_token_in_one_line(host):
    with pytest.raises(BadConfig) as caught:
        load_model(PageConfig, {"host": host, "certificate": "c.pem", "key": "k.pem"}, "b.toml")
    assert f"host {host} is not loopback: TLS and a token are needed" in str(caught.value)
    assert "\n" not in str(caught.value)
    load_model(PageConfig, {"host": host, "certificate": "c", "key": "k", "token_file": "t"}, "b.toml")


@pytest.mark.parametrize("host", ["127.0.0.1", "127.1.2.3", "::1", "localhost"])
def test_loopback_needs_nothing(host):
    assert load_model(PageConfig, {"host": host}, "b.toml").loopback


def test_the_state_is_json_whatever_the_rig_says():
    overview = Overview("b", {"can0": 500_000}, {}, lambda dlc, bitrate: 0)
    assert json.loads(as_json(state_of(overview, 5.0)))["running"] is False
    kind = message("CycleRecord")
    payload = kind.pack(kind.make(seq=1, angle_deg=float("nan"), error_deg=float("inf"), phase=2, mode=1))
    gate = message("ValveStatus")
    overview.take([(key("b", CYCLE), payload), (key("b", VALVES), gate.pack(gate.make(seq=1, gate=2, reason=10)))], 5.0)
    state = json.loads(as_json(state_of(overview, 5.1)))
    assert state["running"]
    assert state["cycle"]["angle_deg"] is None
    assert state["gate"]["state"] == "fault"
    assert state["gate"]["reason"] == "emergency stop"
    assert (state["phase"], state["mode"]) == ("track", "charge")
    assert json.loads(as_json(state_of(overview, 9.0)))["gate"]["state"] == "silent"


def test_events_come_newest_first_with_their_time():
    overview = Overview("b", {}, {}, lambda dlc, bitrate: 0)
    kind = message("Event")
    overview.take([(key("b", EVENT), kind.pack(kind.make(seq=i, stamp_ns=10**9 * i, value=float(i)))) for i in (1, 2)], 0.0)
    told = events_of(overview, lambda event: f"event {event.value:g}", 500_000_000)
    assert [(e["time_s"], e["text"]) for e in told["events"]] == [(1.5, "event 2"), (0.5, "event 1")]


class Gate:
    """A gate that goes where it is asked after `after` requests, or not."""

    def __init__(self, state, leads_to=None, after=1):
        self.state, self.leads_to, self.after, self.asked = state, leads_to, after, []

    def send(self, action):
        self.asked.append(action)
        if self.leads_to is not None and len(self.asked) >= self.after:
            self.state = self.leads_to

    def look(self):
        return self.state, time.monotonic()


@pytest.mark.parametrize(
    ("gate", "action", "obeyed", "asked"),
    [
        (Gate(0, 1), "arm", True, 1),
        (Gate(0, 1, after=3), "arm", True, 3),  # a lost request is said again
        (Gate(2), "arm", False, 1),  # one press is one re-arm
        (Gate(2, 1), "arm", True, 1),
        (Gate(1, 0), "disarm", True, 1),
        (Gate(2), "disarm", False, 1),  # asked on, it would take back the next re-arm
    ],
)
def test_asking_the_gate(gate, action, obeyed, asked):
    assert asyncio.run(ask(gate.send, gate.look, action)) is obeyed
    assert len(gate.asked) == asked


def heard_of(gate):
    kind = message("ValveStatus")
    return kind.pack(kind.make(seq=1, gate=gate))


def test_a_stop_is_said_up_to_the_very_look_that_finds_the_gate_in_fault(monkeypatch):
    monkeypatch.setattr(requests, "STOP_FOR_S", 3600.0)  # it does not give up by itself
    line, sent, newest = StopLine(), [], deque()
    line._requester, line._valves = SimpleNamespace(send=sent.append), SimpleNamespace(take=newest.popleft)
    newest.extend([None, heard_of(1), b"no status", heard_of(2), None])  # one for each look
    assert line.press()
    until(lambda: len(newest) == 1)
    time.sleep(10 * requests.STOP_REPEAT_S)  # time enough to look again
    line.close()
    assert (sent, list(newest)) == (["stop"] * 4, [None])  # at the press and after each look but the last
