"""A whole rig on four hosts: clocks that differ, a router that is killed and comes back, a host that is lost, lockstep."""

import signal
import subprocess
import time

import numpy as np
import pytest

from softloop.deploy.bench import load_bench, shipped_benches
from softloop.deploy.same import differences_from_batch, trace_of
from softloop.offline.log import open_log
from softloop.offline.metrics import truth_errors
from softloop.wire.channels import CYCLE, INCLINATION, PRESSURE, VALVES
from softloop.wire.messages import constant, message
from softloop.wire.session import open_wire
from tests.rig.fleets import CLI, HOSTS, bench_text, fleet, own_clocks_permitted
from tests.rig.test_whole_rig import SHORT, WIDE, short_csv

SIM = shipped_benches()["sim"]
AHEAD_S = {"desk": 0, "devices": 1000, "log": 77, "rig": -400}
GATE_FAULT, GATE_ARMED = constant("ValveStatus", "GATE_FAULT"), constant("ValveStatus", "GATE_ARMED")
BACK_WITHIN_S = 2.0


def text_of(folder, name, **options):
    """Wide budgets and a trajectory of 4 s on four hosts, on a machine that may be busy."""
    short_csv(folder)
    (folder / "wide.toml").write_text(f'base = "{SIM}"\n{WIDE}{SHORT.replace("{bench_dir}", str(folder))}')
    more = "[clock]\nuncertainty_max_ms = 50.0\n"
    return bench_text(name, base=folder / "wide.toml", more=more, **options)


def assert_clean(rigs):
    assert rigs.left_over() == []
    assert list(rigs.folder.glob("*.sock*")) == []


@pytest.mark.rig
@pytest.mark.skipif(not own_clocks_permitted(), reason="needs the right to make a time namespace (root)")
def test_four_hosts_with_clocks_of_their_own_track_as_one(tmp_path):
    text = text_of(tmp_path, "clocks", mode="peer").replace("[run]\n", "[run]\nreport = true\n", 1)
    with fleet(text) as rigs:
        for name in ("log", "devices", "rig", "desk"):
            rigs.start(name, AHEAD_S[name], report=name == "log")
        assert rigs.finish() == dict.fromkeys(HOSTS, 0), rigs.report()
        assert_clean(rigs)
        log = open_log(rigs.hosts["log"].run_dir / "run.mcap")
        assert log.problems == []
        assert truth_errors(log).figures()["max_deg"] < 15.0
        words = log["clock"]
        figures = []
        for number, name in enumerate(HOSTS):
            of_host = words[words["host"] == number]
            assert (len(of_host) > 20) == (name != "desk")
            errors_ns = np.abs(of_host["offset_ns"] + AHEAD_S[name] * 1_000_000_000)
            inside = errors_ns <= of_host["uncertainty_ns"]
            if name != "desk":
                worst_ms, sure_ms = errors_ns.max() / 1e6, np.median(of_host["uncertainty_ns"]) / 1e6
                figures.append(
                    f"{name}: inside {inside.mean():.1%} of {len(of_host)}, {worst_ms:.3f} ms off, sure to {sure_ms:.3f}"
                )
                assert inside.mean() >= 0.95, figures
        print("\n".join(figures))
        tracking = log["cycle"][log["cycle"]["phase"] == constant("CycleRecord", "PHASE_TRACK")]
        for age in ("pressure_age_ns", "inclination_age_ns"):
            assert -1e6 < np.median(tracking[age]) < 50e6, (age, np.median(tracking[age]))
        assert (rigs.hosts["log"].run_dir / "report.html").is_file()
        assert not (rigs.hosts["desk"].run_dir / "report.html").exists()


def is_back(bench, names, patience_s=30.0):
    """Wait until all processes are alive and each steady channel has a new sample; returns how long that took, s."""
    began = time.monotonic()
    with open_wire(bench.zenoh, bench.name, "witness") as wire:
        newest, heard, anew_s = {}, set(), 0.0
        while time.monotonic() - began < patience_s:
            if time.monotonic() > anew_s:  # what the witness declares while its link comes up can be lost
                newest = {channel.name: wire.latest(channel) for channel in (PRESSURE, INCLINATION, VALVES, CYCLE)}
                anew_s = time.monotonic() + 0.5
            heard |= {name for name, latest in newest.items() if latest.take() is not None}
            if len(heard) == len(newest) and wire.processes_alive(timeout_s=0.2) >= set(names):
                return time.monotonic() - began
            time.sleep(0.01)
    raise AssertionError(f"not back: heard {sorted(heard)}")


def gate_of(bench, wanted, patience_s=20.0):
    with open_wire(bench.zenoh, bench.name, "witness") as wire:
        wire.settle(lambda: False)
        latest, end = wire.latest(VALVES), time.monotonic() + patience_s
        while time.monotonic() < end:
            payload = latest.take()
            if payload is not None and message("ValveStatus").unpack(payload).gate == wanted:
                return True
            time.sleep(0.01)
    return False


@pytest.mark.long
def test_a_killed_router_comes_back_within_two_seconds_and_no_process_is_restarted(tmp_path):
    text = text_of(tmp_path, "router", mode="client", shared_router=True)
    with fleet(text.replace("approach_s = 2.0", "approach_s = 3.0")) as rigs:
        router = rigs.start_router()
        for name in HOSTS:
            rigs.start(name)
        rigs.wait_for_word("desk", "gate armed")
        before = {key: process.pid for key, process in rigs.family().items()}
        router.send_signal(signal.SIGKILL)
        router.wait()
        rigs.wait_for_word("desk", "the meeting point is lost")
        time.sleep(1.0)  # without any wire: command silence passes, and the gate vents
        rigs.start_router()
        names = ["plant", "valves", "pressures", "inclinometer", "controller", "recorder"]
        bench = load_bench(rigs.bench)
        took_s = is_back(bench, [*names, "launcher", "launcher-devices", "launcher-log", "launcher-rig"])
        print(f"after a router restart all is back within {took_s:.2f} s")
        assert took_s < BACK_WITHIN_S, took_s
        rigs.wait_for_word("desk", "it waits to be armed again")
        assert gate_of(bench, GATE_FAULT)
        assert {key: process.pid for key, process in rigs.family().items()} == before
        assert request(rigs, "arm") == 0
        assert gate_of(bench, GATE_ARMED)
        assert rigs.finish() == dict.fromkeys(HOSTS, 0), rigs.report()
        assert_clean(rigs)
        log = open_log(rigs.hosts["log"].run_dir / "run.mcap")
        routers = log["event"][log["event"]["kind"] == constant("Event", "KIND_ROUTER")]
        assert 1 in routers["code"].tolist()
        truth = log["truth"]
        after = truth[truth["stamp_ns"] > routers["stamp_ns"][routers["code"] == 1][0]]
        assert after["charge_coil_ma"][0] < 1.0  # vented meanwhile
        armed = log["event"][(log["event"]["kind"] == constant("Event", "KIND_GATE")) & (log["event"]["code"] == GATE_ARMED)]
        assert len(armed) == 2 - (routers["stamp_ns"][0] < armed["stamp_ns"][0])


def request(rigs, action):
    return subprocess.run([*CLI, "request", str(rigs.bench), action], env=rigs.environment, timeout=60, check=False).returncode


def kill_all(rigs, host):
    for _, process in sorted(rigs.hosts[host].family().items()):
        process.kill()


def kill_launcher(rigs, host):
    rigs.hosts[host].family()["launcher"].kill()


@pytest.mark.long
@pytest.mark.parametrize(("host", "kill"), [("devices", kill_all), ("devices", kill_launcher), ("desk", kill_launcher)])
def test_a_lost_host_ends_in_a_vent_and_all_others_end(tmp_path, host, kill):
    with fleet(text_of(tmp_path, "lost", mode="peer")) as rigs:
        for name in HOSTS:
            rigs.start(name)
        rigs.wait_for_word("desk", "phase track")
        kill(rigs, host)
        codes = rigs.finish()
        assert all(code not in (0, None) for code in codes.values()), rigs.report()
        assert rigs.left_over() == []
        truth = open_log(rigs.hosts["log"].run_dir / "run.mcap")["truth"]
        assert truth["charge_coil_ma"][-1] < 1.0, rigs.report()
        assert truth["chamber_pressure_kpa"][-1] < 0.5 * truth["chamber_pressure_kpa"].max()


@pytest.mark.long
def test_lockstep_over_four_hosts_is_the_same_as_in_one_process(tmp_path):
    more = '[pace]\nmode = "lockstep"\n[run]\nduration_s = 1.5\nvent_timeout_s = 0.3\nsettle_s = 0.3\n'
    text = bench_text("step", mode="peer", base=None)
    (tmp_path / "base.toml").write_text(f'base = "{SIM}"\n{more}')
    text = text.replace(f'base = "{SIM}"', f'base = "{tmp_path}/base.toml"')
    with fleet(text) as rigs:
        for name in HOSTS:
            rigs.start(name)
        assert rigs.finish() == dict.fromkeys(HOSTS, 0), rigs.report()
        assert_clean(rigs)
        run_dir = rigs.hosts["log"].run_dir
        log = open_log(run_dir / "run.mcap")
        assert log.problems == []
        trace = trace_of(load_bench(run_dir / "bench.toml", run_dir))
        assert [str(d) for d in differences_from_batch(log, trace)] == []
        assert len(log["cycle"]) == len(trace.cycles) > 300
        assert len(log["clock"]) == 0
