"""The page's server with real sockets: viewers, stalled viewers, requests, and the stop that nothing holds up."""

import asyncio
import http.client
import json
import os
import socket
import subprocess
import sys
import threading
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from softloop.watch.overview import RATE_WINDOW_S
from softloop.watch.page import app, requests
from softloop.watch.page.history import COLUMNS, History
from tests.watch.benches import speaking, write_bench
from tests.watch.pages import served, toy_rig, until
from tests.watch.test_page_parts import cycle, unpacked
from tests.wire.rendezvous import short_folder

PATIENCE_S = 60.0
FRAME_S = 270e-6  # 8 bytes at 500 kbit/s, with as many stuff bits as there can be


@pytest.fixture(scope="module")
def stage():
    """(site, address, rig) of a page beside a toy rig."""
    with short_folder() as folder:
        file = write_bench(folder, f"paged-{os.getpid()}")
        with speaking(file) as speaker, toy_rig(speaker) as rig, served(file) as (site, address):
            until(lambda: site.feed.history.head > 20)
            yield site, address, rig


def post(address, path, body=None, port=None, **headers):
    """(status, JSON or None)."""
    where = urlsplit(address)
    connection = http.client.HTTPConnection(where.hostname, port or where.port, timeout=20)
    connection.request("POST", path, json.dumps(body) if body is not None else None, headers)
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    try:
        return answer.status, json.loads(text)
    except ValueError:
        return answer.status, text


def live(address, **options):
    return connect(address.replace("http", "ws", 1) + "live", max_size=None, proxy=None, **options)


class Viewer:
    """Reads what the server sends."""

    def __init__(self, socket):
        self.socket = socket
        self.rows, self.told = [], {}
        self.count = 0

    def read_until(self, condition):
        """Read on until `condition(self)`: how much comes in a time says more of the machine than of the server."""
        end = time.monotonic() + PATIENCE_S
        while not condition(self):
            assert time.monotonic() < end, f"waited in vain: {self.count} rows came, and {sorted(self.told)}"
            self.take(self.socket.recv(timeout=PATIENCE_S))
        return self

    def take(self, data):
        if isinstance(data, bytes):
            self.rows.append(unpacked(data))
            self.count += len(self.rows[-1])
        else:
            told = json.loads(data)
            self.told[told["kind"]] = told

    @property
    def newest_s(self):
        """Time of the newest row."""
        return self.rows[-1][-1, 0]

    @property
    def columns(self):
        return dict(zip(COLUMNS, np.concatenate(self.rows).T, strict=True))


def rows_after(history, more):
    """Whether a viewer has all rows of now and so many that came later."""
    wanted = history.head + more
    return lambda viewer: viewer.count > wanted


def test_a_viewer_gets_what_was_sent_each_row_once(stage):
    site, address, rig = stage
    with live(address) as socket:
        viewer = Viewer(socket).read_until(rows_after(site.feed.history, 300))
    assert tuple(viewer.told["hello"]["columns"]) == COLUMNS
    seen = viewer.columns
    stamps = np.round(seen["time_s"] * 1e9) + viewer.told["begin"]["start_ns"]
    sent = {c["stamp_ns"]: c for c in rig.cycles}
    keys = np.array(sorted(sent))
    nearest = keys[np.abs(keys[None, :] - stamps[:, None]).argmin(1)]
    assert np.abs(nearest - stamps).max() < 2_000  # a microsecond or two, of f32
    assert len(set(nearest.tolist())) == len(stamps) > 300
    np.testing.assert_allclose(seen["reference_deg"], [sent[k]["reference_deg"] for k in nearest.tolist()], rtol=1e-6)


def test_a_viewer_is_told_the_state_of_the_rig(stage):
    """The load of the bus is that of the frames that came, however many a second this machine sends."""
    _, address, _ = stage

    def complete(viewer):  # the status has come, and frames for longer than the window over which rates are taken
        state = viewer.told.get("state", {})
        if not state.get("processes") or "cycle" not in state:
            return False
        return state["cycle"]["stamp_ns"] - viewer.told["begin"]["start_ns"] > (RATE_WINDOW_S + 1.0) * 1e9

    with live(address) as socket:
        state = Viewer(socket).read_until(complete).told["state"]
    assert state["gate"]["state"] in ("disarmed", "armed", "fault")
    assert {p["name"] for p in state["processes"]} == {"controller"}
    assert state["rates"]["can"] > 0.0
    assert state["buses"]["can0"] == pytest.approx(100.0 * FRAME_S * state["rates"]["can"], abs=0.02)  # both are rounded


def test_two_viewers_see_the_same(stage):
    site, address, _ = stage
    with live(address) as one, live(address) as two:
        first, second = Viewer(one), Viewer(two)
        plenty = rows_after(site.feed.history, 100)
        threads = [threading.Thread(target=v.read_until, args=(plenty,)) for v in (first, second)]
        [t.start() for t in threads]
        [t.join() for t in threads]
    common = min(len(first.columns["time_s"]), len(second.columns["time_s"]))
    assert common > 100
    for name in COLUMNS:  # times are told as f32 from the first of their message, and the viewers' messages may differ
        atol = 1e-6 if name == "time_s" else 0.0
        np.testing.assert_allclose(first.columns[name][:common], second.columns[name][:common], rtol=0, atol=atol)


def test_a_viewer_that_stalls_holds_nobody_up_and_comes_back_at_the_newest(stage):
    site, address, _ = stage
    history = site.feed.history
    with live(address, ping_interval=None, close_timeout=0.1) as stalled, live(address) as other:
        stalled.recv()
        until(lambda: site.viewers == 2)
        since_s, plenty = history.rows(history.head - 1, history.head)[0, 0], rows_after(history, 600)
        raw = stalled.socket  # from here on nothing is read: the kernel's buffers fill, then the server's task waits
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        viewer = Viewer(other).read_until(lambda viewer: plenty(viewer) and viewer.newest_s > since_s + 5.0)
        assert site.viewers == 2, "all that came while the stalled one was there"
        kept, got = history.rows(0, history.head)[:, 0], viewer.columns["time_s"]
        start = int(np.argmin(np.abs(kept - got[0])))
        np.testing.assert_allclose(got, kept[start : start + len(got)], atol=1e-3)  # the other one missed nothing


class ShortFeed:
    """A feed of a few turns with seven rows each."""

    events_seen = frame = turns = 0
    events = state = "{}"

    def __init__(self):
        self.history = History(10_000)

    async def wait(self):
        self.turns += 1
        if self.turns > 5:
            raise asyncio.CancelledError
        self.history.append([cycle(self.history.head + i) for i in range(7)])


class Slow:
    """A socket that takes 25 s for its third block of rows."""

    def __init__(self, history):
        self.history, self.blocks = history, []

    async def send_text(self, text):
        pass

    async def send_bytes(self, data):
        self.blocks.append(unpacked(data))
        if len(self.blocks) == 3:
            first = self.history.head
            self.history.append(cycle(first + i) for i in range(5000))


def test_a_viewer_far_behind_goes_on_at_the_newest_rows(stage):
    made = app.Site(ShortFeed(), stage[0].stop_line)
    slow = Slow(made.feed.history)
    with pytest.raises(asyncio.CancelledError):
        asyncio.run(app._send(made, slow))
    assert [len(block) for block in slow.blocks[:3]] == [7, 7, 7]
    assert len(slow.blocks[3]) == app.KEPT_ROWS
    assert slow.blocks[-1][-1, 0] == pytest.approx(0.005 * (made.feed.history.head - 1))


def test_buttons_reach_the_gate(stage):
    _, address, rig = stage
    assert post(address, "/request/arm") == (200, {"obeyed": True})
    assert rig.gate == 1
    assert post(address, "/request/disarm") == (200, {"obeyed": True})
    assert post(address, "/request/fly")[0] == 404
    assert post(address, "/action/nothing", {})[0] == 404


def test_a_stop_needs_nothing_but_its_own_thread(stage):
    """The page's own loop is kept busy for two seconds; the stop on its own port is at the gate long before."""
    site, address, rig = stage
    assert post(address, "/request/arm") == (200, {"obeyed": True})
    busy, turn = threading.Event(), site.feed.turn

    def blocking_turn(now_s):
        site.feed.turn = turn
        busy.set()
        time.sleep(2.0)

    site.feed.turn = blocking_turn
    assert busy.wait(5)
    began = time.monotonic()
    rig.requests.clear()
    assert post(address, "/stop", port=site.stop_port) == (200, {"sent": True})
    until(lambda: rig.gate == 2)
    assert rig.requests[0][0] == "stop"
    assert time.monotonic() - began < 1.5  # the busy loop is not free before 2 s
    assert post(address, "/request/arm") == (200, {"obeyed": True})


@pytest.fixture
def stops(stage, monkeypatch):
    """What the stop line says: "stop" for each one sent, "fault" when it finds the gate there. It does not give up by itself."""
    line, said = stage[0].stop_line, []
    send, in_fault = line._requester.send, line._in_fault

    def find():
        found = in_fault()
        said.extend(["fault"] * found)
        return found

    monkeypatch.setattr(requests, "STOP_FOR_S", 3600.0)
    monkeypatch.setattr(line._requester, "send", lambda action: said.append(action) or send(action))
    monkeypatch.setattr(line, "_in_fault", find)
    return said


def test_a_stop_is_repeated_until_the_gate_is_in_fault_and_then_no_more(stage, stops):
    _, address, rig = stage
    rig.requests.clear()
    post(address, "/stop")
    until(lambda: "fault" in stops)
    assert rig.gate == 2
    time.sleep(0.7)
    assert stops == ["stop"] * (len(stops) - 1) + ["fault"]
    assert [a for a, _ in rig.requests] == ["stop"] * len(rig.requests)
    assert post(address, "/request/arm") == (200, {"obeyed": True})
    time.sleep(0.7)
    assert rig.gate == 1


def test_the_stop_works_as_a_word_on_the_socket_and_as_a_form(stage):
    _, address, rig = stage
    post(address, "/request/arm")
    with live(address) as socket:
        socket.send("stop")
        until(lambda: rig.gate == 2)
    post(address, "/request/arm")
    assert post(address, "/stop", Accept="text/html")[0] == 303
    until(lambda: rig.gate == 2)


def test_strangers_are_refused(stage):
    site, address, _ = stage
    assert post(address, "/request/arm", Origin="http://evil.example")[0] == 403
    assert post(address, "/stop", port=site.stop_port, Host="rebound.example")[0] == 403
    with pytest.raises(InvalidStatus), live(address, origin="http://evil.example"):
        pass


def test_the_page_loads_from_here_alone(stage):
    site, address, _ = stage
    where = urlsplit(address)
    connection = http.client.HTTPConnection(where.hostname, where.port, timeout=20)
    connection.request("GET", "/")
    answer = connection.getresponse()
    policy = answer.getheader("Content-Security-Policy")
    text = answer.read().decode()
    assert f"connect-src 'self' http://127.0.0.1:{site.stop_port}" in policy
    assert "default-src 'none'" in policy
    assert "http" not in text.replace("http-equiv", "")
    for path in ("/files/uplot/LICENSE", "/files/uplot/uPlot.iife.min.js", "/files/page.js"):
        connection.request("GET", path)
        answer = connection.getresponse()
        assert answer.status == 200
        assert answer.read()
    connection.close()


def test_a_port_in_use_is_one_line_and_the_process_needs_no_compiler(tmp_path):
    with short_folder() as folder, socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        file = write_bench(folder, "in-use")
        command = [sys.executable, "-m", "softloop.deploy.cli", "page", str(file), "--port", str(port)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 3
        assert done.stderr.startswith(f"softloop: the page cannot listen on 127.0.0.1 port {port}")
        assert done.stderr.count("\n") == 1
    code = "import sys, softloop.deploy.page; print([m for m in ('numba', 'scipy', 'matplotlib') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"


def test_a_rig_that_comes_later_and_comes_again_is_shown():
    with short_folder() as folder:
        file = write_bench(folder, f"later-{os.getpid()}")
        with served(file) as (site, address):
            assert post(address, "/stop")[0] == 503
            assert post(address, "/request/arm")[0] == 503
            for _ in range(2):
                with speaking(file) as speaker, toy_rig(speaker) as rig:
                    before = site.feed.history.head
                    until(lambda before=before: site.feed.history.head > before + 50)
                    until(lambda: post(address, "/request/arm") == (200, {"obeyed": True}))
                    post(address, "/stop", port=site.stop_port)
                    until(lambda rig=rig: rig.gate == 2)
                until(lambda: not json.loads(site.feed.state)["running"])
