"""What the doctor makes of a bench on several hosts: its own share, the offset of its clock, its identities."""

import subprocess
import sys

import pytest
from tests.wire.rendezvous import meeting

from softloop.deploy.bench import load_bench, shipped_benches
from softloop.deploy.doctor import alone
from softloop.deploy.doctor_clock import judge_offset, offset
from softloop.deploy.doctor_devices import buses_of, is_real
from softloop.deploy.doctor_identity import identities, judge_identities, needed_here
from softloop.deploy.hosts import shares
from softloop.devices.protocols import can_frames
from softloop.wire.clock import WallClock
from softloop.wire.clock_config import ClockConfig
from softloop.wire.clock_offset import Exchange
from softloop.wire.host_clock import TimeServer
from softloop.wire.session import open_wire

MS = 1_000_000
AT = can_frames.VALVE_STATUS_ID

HOSTS = (
    "[hosts.desk]\n[hosts.board]\n[controller]\nhost = 'desk'\n[recorder]\nhost = 'desk'\n[plant]\nhost = 'board'\n"
    "[valves]\nhost = 'board'\n[pressures]\nhost = 'board'\n[inclinometer]\nhost = 'board'\n"
)


class Ahead(WallClock):
    """A clock that is ahead of this machine's by a second."""

    def now_ns(self):
        return super().now_ns() + 1_000 * MS


def test_a_host_is_looked_at_as_if_it_were_alone_and_for_its_own_devices(bench):
    whole = bench(HOSTS)
    single = alone(whole)
    assert (single.hosts, single.valves.host, single.zenoh.endpoint) == ({}, "", "")
    assert buses_of(single, shares(whole)["board"]) == ["can0"]
    assert buses_of(single, shares(whole)["desk"]) == []
    assert not is_real(bench('[inclinometer]\nport = "/dev/ttyUSB0"\n'), ("controller",))


def test_the_offset_to_the_host_that_leads_is_found_over_the_network(bench):
    with meeting() as zenoh, open_wire(zenoh, "examined", "leads") as wire:
        whole = bench(HOSTS).model_copy(update={"zenoh": zenoh})
        wire.settle(lambda: False)
        assert offset(whole, "desk", 0.1).found == "this host keeps the rig clock"
        unanswered = offset(whole, "board", 0.1)
        assert (unanswered.verdict, "softloop run --host desk" in unanswered.do) == ("warn", True)
        server = TimeServer(wire, Ahead())
        check = offset(whole, "board", 1.0)
        assert check.measured["offset_ms"] == pytest.approx(1000.0, abs=check.measured["uncertainty_ms"] + 0.01)
        assert check.measured["steps"] == 0
        del server


def exchanges(step_ms=0.0, delay_ms=1.0, count=40):
    found = []
    for i in range(count):
        own, away = i * 100 * MS, round((5.0 + (step_ms if 2 * i >= count else 0.0)) * MS)
        half = round(0.5 * delay_ms * MS)
        found.append(Exchange(own, own + half + away, own + half + away, own + 2 * half))
    return found


def test_an_offset_must_be_known_well_and_not_jump():
    config = ClockConfig()
    good = judge_offset(config, exchanges(), 0)
    assert (good.verdict, good.measured["offset_ms"]) == ("pass", pytest.approx(5.0, abs=0.01))
    assert judge_offset(config, exchanges(delay_ms=10.0), 0).verdict == "fail"
    assert judge_offset(config, exchanges(step_ms=50.0), 0).verdict == "fail"


def test_identities_that_are_missing_are_each_named(bench, tmp_path):
    assert identities(bench()) == []
    assert needed_here(bench(HOSTS), "board") == ["plant", "valves", "pressures", "inclinometer", "follower"]
    assert needed_here(bench(HOSTS), "desk") == ["recorder", "controller", "launcher", "router"]
    check = judge_identities(tmp_path, "examined", ["valves", "launcher"])
    assert (check.verdict, check.measured["unusable"]) == ("fail", 2)
    assert "softloop keys" in check.do


def test_identities_that_softloop_keys_made_are_usable(tmp_path):
    file = tmp_path / "secured.toml"
    file.write_text(
        'base = "' + str(shipped_benches()["sim"]) + '"\nname = "secured"\n[zenoh]\nendpoint = "tls/127.0.0.1:7447"\n'
        f'[zenoh.tls]\nfolder = "{tmp_path}/keys"\n'
    )
    done = subprocess.run(
        [sys.executable, "-m", "softloop.deploy.cli", "keys", str(file)], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    (check,) = identities(load_bench(file, tmp_path))
    assert check.verdict == "pass", check.found
    (tmp_path / "keys" / "valves.key").chmod(0o644)
    (check,) = identities(load_bench(file, tmp_path))
    assert (check.verdict, check.measured["unusable"], "valves.key" in check.found) == ("fail", 1, True)
