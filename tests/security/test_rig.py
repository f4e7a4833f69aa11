"""The whole rig over TLS: what its processes really declare and say is what the table lets them."""

import re
import sys
from pathlib import Path

import pytest

from softloop.offline.run_log import open_run
from softloop.wire.channels import CHANNELS
from tests.campaigns.flood import NAME, Site
from tests.rig import fleets, rigs
from tests.rig.test_hosts import text_of
from tests.security.secured import make

TRACE = "zenoh::net::routing::interceptor=trace"
LINE = re.compile(r"(ThreadId\(\d+\)) zenoh::net::routing::interceptor\S*: (.*)")
# What Zenoh would send to a new neighbour of which it does not know yet what it wants. Who lacks the right to hear or answer what
# it does want has its declaration refused.
UNASKED = re.compile(r"unauthorized to (Put|Query) \(egress\)")


def refused(text):
    """What the access rules refused, from Zenoh's trace: the line before each refusal, by the thread that wrote it."""
    last, found = {}, []
    for line in re.sub(r"\x1b\[[0-9;]*m", "", text).splitlines():
        match = LINE.search(line)
        if match is None:
            continue
        thread, said = match.groups()
        # A refusal whose reason is not there, for lines of two threads that ran into each other, is left out: a right that is
        # missing is refused on more than one link.
        reason = last.get(thread, "")
        if "intercepted" in said and "unauthorized" in reason and not UNASKED.search(reason):
            found.append(reason)
        last[thread] = said
    return found


@pytest.fixture(params=["client", "peer"])
def site(request):
    made = Site(request.param)
    yield made
    made.close()


@pytest.mark.long
@pytest.mark.parametrize("pace", ["wall", "lockstep"])
def test_nothing_that_a_rig_does_is_refused(site, pace, monkeypatch):
    monkeypatch.setenv("RUST_LOG", TRACE)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[2]))
    monkeypatch.setattr(rigs, "PROGRAM", (sys.executable, "-m", "tests.security.traced_cli"))
    with rigs.running(site.text, name=NAME, arguments=("--duration", "3", "--pace", pace)) as rig:
        # On a busy machine the trace alone may cost the gate its budgets; what is asked here is what was refused until then.
        code = rig.finish()
        assert code == 0 or (pace == "wall" and "gate armed" in rig.output), rig.output[-2000:] + rig.logs()
        said = {"launcher": rig.output} | {file.name: file.read_text() for file in rig.run_dir.glob("*.log")}
        assert "interceptor" in said["launcher"], "Zenoh's trace is not there"
        assert {name: refused(text) for name, text in said.items() if refused(text)} == {}
        log = open_run(rig.run_dir)
        spoken = {c.name for c in CHANNELS if c.logged and c.name not in ("can", "canbus", "clock", "shadow")}
        unasked = set() if code == 0 else {"request"}  # a rig that went to FAULT by itself is not asked to disarm
        assert {name for name in spoken if len(log[name])} | unasked == spoken
        assert {f"{number:x}" for _, number in log.can} == {"80", "90", "100"}


def test_the_trace_shows_a_refusal():
    """Or the test above could not fail."""
    thread = "2026-01-01T00:00:00Z TRACE rx-0 ThreadId(08) zenoh::net::routing::interceptor"
    text = f"{thread}::access_control: a is unauthorized to Put (ingress) on b\n{thread}: Msg intercepted!\n"
    assert refused(text) == ["a is unauthorized to Put (ingress) on b"]
    assert refused(text.replace("intercepted", "passed")) == []


@pytest.mark.long
@pytest.mark.parametrize(("mode", "shared_router"), [("peer", False), ("client", True)])
def test_nor_is_anything_refused_of_a_rig_on_four_hosts(tmp_path, mode, shared_router, monkeypatch):
    """Launchers of hosts that do not lead, the clock's questions, and a router that is nobody's launcher."""
    monkeypatch.setenv("RUST_LOG", TRACE)
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[2]))
    monkeypatch.setattr(fleets, "CLI", (sys.executable, "-m", "tests.security.traced_cli"))
    table = '[zenoh.tls]\nfolder = "{bench_dir}/keys"\n[run]\n'
    text = text_of(tmp_path, "hosts", mode=mode, shared_router=shared_router)
    text = text.replace("tcp/", "tls/", 1).replace("[run]\n", table, 1)
    with fleets.fleet(text) as rigs:
        make(rigs.bench)
        if shared_router:
            rigs.start_router()
        for name in fleets.HOSTS:
            rigs.start(name)
        codes = rigs.finish()
        assert codes == dict.fromkeys(fleets.HOSTS, 0) or "gate armed" in rigs.hosts["desk"].output, rigs.report()
        files = [*rigs.folder.glob("*.txt"), *rigs.folder.glob("*/*.log")]
        assert {file.name: found for file in files if (found := refused(file.read_text()))} == {}
        assert len(open_run(rigs.hosts["log"].run_dir)["clock"]) > 0
        assert rigs.left_over() == []
