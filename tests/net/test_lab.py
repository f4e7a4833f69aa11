"""Namespaces, links, the relay on its TUN device, and that nothing of it is left. Needs root; by `make test-net`."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from tests.net.cable import Way
from tests.net.lab import Namespace, Network, counts, links_of_this_computer, missing

pytestmark = pytest.mark.net

ECHO = """
import socket
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.bind(("0.0.0.0", 9))
print("up", flush=True)
while True:
    s.sendto(*s.recvfrom(100))
"""
ASK = """
import json, socket, sys, time
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.settimeout(0.3)
s.connect((sys.argv[1], 9))
took = []
for _ in range(int(sys.argv[2])):
    began = time.monotonic()
    try:
        s.send(b"x")
        s.recv(10)
        took.append(1e3 * (time.monotonic() - began))
    except OSError:
        pass
print(json.dumps(took))
"""
HANGS = """
import time
from tests.net.lab import Network
network = Network({"a": 5})
print(network.middle.pid, network.hosts["a"].pid, flush=True)
time.sleep(600)
"""


@pytest.fixture
def pair():
    network = Network({"a": 0, "b": 1000})
    echo = subprocess.Popen(network.hosts["a"].inside([sys.executable, "-c", ECHO]), stdout=subprocess.PIPE, text=True)
    try:
        assert echo.stdout.readline() == "up\n"
        yield network
    finally:
        echo.kill()
        echo.communicate()
        network.close()


def asked(network, times):
    """Round trips from b to a that came about, ms."""
    command = network.hosts["b"].inside([sys.executable, "-c", ASK, network.address_of("a"), str(times)])
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout)


def test_each_host_has_a_monotonic_clock_of_its_own(pair):
    read = [sys.executable, "-c", "import time; print(time.monotonic())"]
    a, b = (float(subprocess.run(pair.hosts[h].inside(read), capture_output=True, text=True, check=True).stdout) for h in "ab")
    assert 1000.0 <= b - a < 1010.0
    assert abs(time.monotonic() - a) < 10.0


def test_the_relay_delays_both_ways_and_loses_what_its_seed_says(pair, tmp_path):
    assert min(asked(pair, 20)) < 5.0
    file = tmp_path / "relay.json"
    with pair.relayed(Way(delay_ms=10.0, loss=0.2), 1, file):
        took = asked(pair, 60)
    assert min(took) >= 20.0
    there, back = (counts(file)["directions"][way] for way in ("10.77.2.2>10.77.1.2", "10.77.1.2>10.77.2.2"))
    assert there["put_in"] == 60
    assert back["put_in"] == there["passed"] == 60 - there["lost"]
    assert len(took) <= back["passed"] <= 60 - there["lost"]
    assert 3 <= there["lost"] <= 25
    assert len(asked(pair, 5)) == 5  # and without the relay the way is as before


def test_a_cable_that_is_out_carries_nothing_and_all_again_once_it_is_in(pair):
    pair.cable("b", plugged=False)
    assert asked(pair, 3) == []
    pair.cable("b", plugged=True)
    assert len(asked(pair, 5)) >= 4


def gone(pids, patience_s=10.0):
    end = time.monotonic() + patience_s
    while any(os.path.exists(f"/proc/{pid}") for pid in pids) and time.monotonic() < end:
        time.sleep(0.05)
    return not any(os.path.exists(f"/proc/{pid}") for pid in pids)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_however_it_ends_nothing_is_left(number):
    before = links_of_this_computer()
    maker = subprocess.Popen([sys.executable, "-c", HANGS], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    pids = [int(word) for word in maker.stdout.readline().split()]
    assert len(pids) == 2
    maker.send_signal(number)
    maker.wait(10)
    maker.stdout.close()
    assert gone(pids)
    assert links_of_this_computer() == before


def test_a_program_in_a_host_ends_with_us():
    script = (
        "import subprocess, sys; from tests.net.lab import Namespace; host = Namespace();"
        "print(subprocess.Popen(host.inside(['sleep', '600'])).pid, flush=True); sys.stdin.read()"
    )
    maker = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    pid = int(maker.stdout.readline())
    maker.kill()
    maker.communicate()
    assert gone([pid])


def test_without_root_one_line_says_so(monkeypatch):
    assert missing() == ""
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert missing() == "needs root, to make network namespaces and TUN devices; try `sudo make test-net`"


def test_netem_is_used_where_the_kernel_has_it_and_only_there():
    network = Network({"a": 0})
    try:
        if network.has_netem():
            with network.netem(Way(delay_ms=3.0)):
                assert any(q.get_attr("TCA_KIND") == "netem" for q in network.middle.route.get_qdiscs())
        assert not any(q.get_attr("TCA_KIND") == "netem" for q in network.middle.route.get_qdiscs())
    finally:
        network.close()


def test_a_namespace_is_closed_once_and_again():
    host = Namespace()
    host.close()
    assert gone([host.pid])
