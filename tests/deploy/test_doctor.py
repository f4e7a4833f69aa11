"""What the doctor makes of what it sees: each verdict on made-up findings, on both sides of its limit."""

import json
import subprocess
import sys

import pytest
from tests.wire.rendezvous import meeting

from softloop.deploy import doctor_host
from softloop.deploy.bench import load_bench, shipped_benches
from softloop.deploy.doctor import alone, certified, lines, timing
from softloop.deploy.doctor_can import STUCK_SAMPLES, Heard, answering, at_rest, driver, load
from softloop.deploy.doctor_check import Check, judged, worst
from softloop.deploy.doctor_clock import clock, clock_source, day_error_ms, judge_offset, offset
from softloop.deploy.doctor_devices import bus_is_simulated, buses_of, inclinometer_is_simulated, is_real
from softloop.deploy.doctor_identity import identities, judge_identities, needed_here
from softloop.deploy.doctor_inclinometer import _nothing_usable, judge_samples
from softloop.deploy.hosts import shares
from softloop.deploy.rotate import MIB, RunFolder
from softloop.deploy.run_dir import CERTIFICATE_FILE, keep_certificate, read_certificate
from softloop.devices.protocols import can_frames, wt931
from softloop.devices.protocols.quantise import kpa_to_counts
from softloop.watch.config import RecorderConfig
from softloop.wire.clock import WallClock
from softloop.wire.clock_config import ClockConfig
from softloop.wire.clock_offset import Exchange
from softloop.wire.errors import BadConfig, BadFile
from softloop.wire.host_clock import TimeServer
from softloop.wire.mcap_layout import attachments_of
from softloop.wire.session import open_wire

MS = 1_000_000
AT = can_frames.VALVE_STATUS_ID


@pytest.fixture
def bench(tmp_path):
    """The bench of a file's text over the shipped simulated one."""

    def load_text(text="", base="sim"):
        file = tmp_path / "b.toml"
        file.write_text(f'base = "{shipped_benches()[base]}"\nname = "examined"\n{text}')
        return load_bench(file, tmp_path)

    return load_text


def test_the_worst_verdict_counts():
    assert worst([]) == "pass"
    assert worst(["pass", "warn", "pass"]) == "warn"
    assert worst(["warn", "fail", "pass"]) == "fail"
    assert [judged(value, 1.0, 2.0) for value in (1.0, 1.5, 2.0, 2.1)] == ["pass", "warn", "warn", "fail"]


def test_ticks_in_time_pass_late_ones_warn_and_those_beyond_the_hold_fail(bench):
    good = [60_000] * 999
    assert doctor_host.lateness(bench(), [*good, 1_400_000], 0).verdict == "pass"
    assert doctor_host.lateness(bench(), [*good, 1_600_000], 0).verdict == "warn"  # later than the gate waits: one tick
    assert doctor_host.lateness(bench(), [*good, 15_100_000], 3).verdict == "fail"  # the gate holds no command for so long
    many = doctor_host.lateness(bench(), [60_000] * 98 + [2_000_000] * 2, 0)
    assert many.verdict == "fail"  # one in fifty
    assert many.measured["histogram_us"] == {
        "0": 0, "50": 98, "100": 0, "200": 0, "500": 0, "1000": 0, "2000": 2, "5000": 0, "10000": 0,
    }  # fmt: skip


def test_a_histogram_counts_each_value_once_and_shows_the_rare_one():
    shape = doctor_host.histogram([0.0, 49.9, 50.0, 12_000.0, *[70.0] * 1000])
    assert sum(shape.values()) == 1004
    assert (shape["0"], shape["50"], shape["10000"]) == (2, 1001, 1)
    drawn = doctor_host.bars(shape).splitlines()
    assert len(drawn) == len(shape)
    assert drawn[-1].endswith("1 #")


def test_round_trips_are_judged_by_the_declared_delay_their_loss_and_their_drift(bench):
    steady = [300_000] * 900
    assert doctor_host.zenoh(bench(), steady, 0).verdict == "pass"
    assert doctor_host.zenoh(bench(), [*steady, 2_100_000], 0).verdict == "warn"  # beyond path_delay_ms, within the slack
    assert doctor_host.zenoh(bench(), [*steady, 17_100_000], 0).verdict == "fail"
    assert doctor_host.zenoh(bench(), [1_500_000] * 900, 0).verdict == "warn"
    assert doctor_host.zenoh(bench(), [2_500_000] * 900, 0).verdict == "fail"
    assert doctor_host.zenoh(bench(), steady, 1).verdict == "warn"
    assert doctor_host.zenoh(bench(), steady, 20).verdict == "fail"
    assert doctor_host.zenoh(bench(), [], 900).verdict == "fail"
    drifting = doctor_host.zenoh(bench(), [300_000] * 300 + [500_000] * 300 + [700_000] * 300, 0)
    assert drifting.verdict == "warn"
    assert (drifting.measured["first_third_us"], drifting.measured["last_third_us"]) == (300.0, 700.0)


def test_without_permissions_a_real_rig_fails_and_a_simulated_one_is_warned(bench):
    seen = {"realtime": False, "locked_kib": 0}
    assert [c.verdict for c in doctor_host.permissions(bench(), seen, real=True)] == ["fail", "fail"]
    assert [c.verdict for c in doctor_host.permissions(bench(), seen, real=False)] == ["warn", "warn"]
    granted = doctor_host.permissions(bench(), {"realtime": True, "locked_kib": 90_000}, real=True)
    assert granted[1].verdict == "pass"
    assert all(check.do for check in doctor_host.permissions(bench(), seen, real=True))
    asked_for_none = bench("[host]\nrealtime_priority = 0\n")
    assert [c.verdict for c in doctor_host.permissions(asked_for_none, seen, real=True)] == ["pass"]


def test_a_real_time_kernel_without_its_guard_is_said(bench, tmp_path, monkeypatch):
    guard = tmp_path / "guard"
    monkeypatch.setattr(doctor_host, "RT_GUARD", guard)
    seen = {"realtime": True, "locked_kib": 90_000}
    for text, verdict in (("950000\n", "pass"), ("-1\n", "warn")):
        guard.write_text(text)
        assert doctor_host.permissions(bench(), seen, real=True)[0].verdict == verdict


def test_a_child_that_could_not_measure_is_a_failure(bench):
    (check,) = timing(bench(), "it did not end", real=True)
    assert (check.verdict, "it did not end" in check.found) == ("fail", True)
    checks = timing(
        bench(), {"realtime": True, "locked_kib": 1, "late_ns": [1], "skipped": 0, "zenoh_error": "no such folder"}, real=True
    )
    assert (checks[-1].name, checks[-1].verdict, checks[-1].found) == ("Zenoh round trip", "fail", "no such folder")


def test_room_for_the_log(bench, tmp_path):
    hour = doctor_host.log_bytes_s() * 3600
    verdicts = [doctor_host._room(tmp_path, int(part * hour)).verdict for part in (1.1, 0.9, 0.2, 0.1, 0.0)]
    assert verdicts == ["pass", "warn", "warn", "fail", "fail"]
    assert [c.verdict for c in doctor_host.disk(bench(), tmp_path / "gone")] == ["fail"]
    assert doctor_host.existing(tmp_path / "a" / "b") == tmp_path


def test_what_is_left_of_the_budget(tmp_path):
    def verdict(used_mib, over_budget="refuse"):
        config = RecorderConfig(budget_mib=100, over_budget=over_budget)
        return doctor_host._budget(config, [RunFolder(tmp_path, int(used_mib * MIB), 0)]).verdict

    assert [verdict(used) for used in (0, 90, 91, 100, 101)] == ["pass", "pass", "warn", "warn", "fail"]
    assert verdict(101, "remove") == "pass"


def test_stalls_against_what_the_recorder_bears(bench, tmp_path):
    held_s = 64 * 2**20 / doctor_host.log_bytes_s()
    for worst_s, verdict in ((0.4, "pass"), (0.6, "warn"), (held_s + 1, "fail")):
        assert doctor_host._stalls(bench(), tmp_path, [0.001] * 39 + [worst_s]).verdict == verdict
    assert doctor_host.write_stalls(tmp_path)
    assert list(tmp_path.glob("tmp*")) == []


def test_versions_that_are_not_what_is_asked_for(monkeypatch):
    assert doctor_host.library_versions().verdict in ("pass", "warn")
    monkeypatch.setattr(doctor_host.metadata, "requires", lambda _: ["numpy>=99", "nothing-of-that-name>=1", "x; extra == 'dev'"])
    check = doctor_host.library_versions()
    assert check.verdict == "fail"
    assert "needs >=99" in check.found
    assert "nothing-of-that-name is missing" in check.found


def test_clocks():
    assert clock("tsc", 12.0).verdict == "pass"
    assert clock("tsc", None).verdict == "warn"
    assert clock("tsc", 5000.0).verdict == "warn"
    assert clock("hpet", 12.0).verdict == "warn"
    assert clock(clock_source(), day_error_ms()).verdict in ("pass", "warn")


# --- CAN


def heard(rate_hz=200.0, span_s=5.0, **more):
    counts = {can_frames.VALVE_STATUS_ID: round(rate_hz * span_s), can_frames.ANALOG_INPUTS_ID: round(200 * span_s)}
    return Heard(span_s=span_s, counts=counts, **more)


EXPECTED = {"valve driver": (can_frames.VALVE_STATUS_ID, 200.0)}


@pytest.mark.parametrize(
    ("found", "verdict", "said"),
    [
        (heard(), "pass", "200 Hz of 200"),
        (heard(rate_hz=185.0), "pass", "185 Hz"),
        (heard(rate_hz=170.0), "fail", "170 Hz"),
        (heard(rate_hz=0.0), "fail", "0 Hz"),
        (heard(errors=3), "warn", "error frames 3"),
        (heard(malformed=1), "warn", "malformed 1"),
        (heard(bus_off=True), "fail", "bus off"),
        (Heard(), "fail", "nobody speaks"),
    ],
)
def test_who_answers_on_a_bus(found, verdict, said):
    check = answering("CAN can0", found, EXPECTED)
    assert check.verdict == verdict
    assert said in check.found
    assert bool(check.do) == (verdict != "pass")


def test_the_load_counts_the_commands_that_are_not_there_yet():
    found = heard()
    found.busy_ns = round(0.5 * 5e9)
    quiet = load("l", found, 500_000)
    assert quiet.measured["load_with_commands"] > quiet.measured["load"] == pytest.approx(0.5)
    found.counts[can_frames.VALVE_COMMAND_ID] = 1000
    commanded = load("l", found, 500_000)
    assert commanded.measured["load_with_commands"] == commanded.measured["load"]
    found.busy_ns = round(0.9 * 5e9)
    assert load("l", found, 500_000).verdict == "fail"


def status_frames(state=can_frames.STATE_WATCHDOG, charge=0, exhaust=20_000, count=20):
    frames = [
        can_frames.encode_valve_status(can_frames.ValveStatusFrame(i % 15, state, charge, exhaust, 0)) for i in range(count)
    ]
    return heard(status=frames)


def test_a_driver_that_vents_by_itself_passes(bench):
    check = driver(bench(), status_frames())
    assert (check.verdict, check.do) == ("pass", "")
    assert check.measured["exhaust_coil_ma"] == 200.0


@pytest.mark.parametrize(
    ("frames", "verdict", "said"),
    [
        (status_frames(state=can_frames.STATE_OK), "fail", "its watchdog does not vent"),
        (status_frames(charge=3000), "fail", "its watchdog does not vent"),
        (status_frames(exhaust=15_000), "warn", "exhaust 150.0 mA"),
        (status_frames(exhaust=0), "fail", "exhaust 0.0 mA"),
    ],
)
def test_a_driver_that_does_not_vent_as_it_should(bench, frames, verdict, said):
    check = driver(bench(), frames)
    assert (check.verdict, bool(check.do)) == (verdict, True)
    assert said in check.found


def test_a_driver_with_broken_frames_and_one_that_is_commanded(bench):
    broken = status_frames()
    broken.status = [bytes([data[0] ^ 1]) + data[1:] for data in broken.status]
    assert "counter and CRC" in driver(bench(), broken).found
    some = status_frames()
    some.status[5] = bytes(8)
    assert driver(bench(), some).verdict == "warn"
    commanded = status_frames()
    commanded.counts[can_frames.VALVE_COMMAND_ID] = 5
    assert (driver(bench(), commanded).verdict, driver(bench(), commanded).found) == ("fail", "somebody else commands the valves")


def analog(chamber_kpa, supply_kpa=300.0, count=STUCK_SAMPLES, noise=16):
    counts = [kpa_to_counts(value, 0.0, 10.0, 250.0) for value in (min(supply_kpa, 250.0), chamber_kpa)]
    return [can_frames.AnalogFrame(counts[0], counts[1] + noise * (i % 2), i % 256) for i in range(count)]


def test_pressures_of_a_rig_at_rest(bench):
    assert at_rest(bench(), analog(0.3)).verdict == "pass"
    assert at_rest(bench(), analog(20.0)).verdict == "warn"
    stuck = at_rest(bench(), analog(0.0, noise=0))
    assert stuck.verdict == "warn"
    assert "does not move" in stuck.found
    assert at_rest(bench(), analog(0.0, noise=0, count=STUCK_SAMPLES - 1)).verdict == "pass"  # too few to tell


def test_a_cut_wire_of_a_live_zero_sensor_is_out_of_range(bench):
    check = at_rest(bench("[pressures.chamber]\nzero_v = 1.0\nfull_v = 5.0\n"), analog(0.0))
    assert check.verdict == "fail"
    assert "out of the sensor's range" in check.found


# --- inclinometer


def samples(rate_hz=200.0, angle=100, count=600, gap_at=None, gap_ms=0.0):
    found = []
    for i in range(count):
        late = round(gap_ms * MS) if gap_at is not None and i >= gap_at else 0
        stamp = round(i * 1e9 / rate_hz) + late
        found.append(wt931.Sample(wt931.SAMPLE, angle + i % 3, 0, stamp, stamp))
    return found


@pytest.mark.parametrize(
    ("heard_samples", "rejected", "verdict"),
    [
        (samples(), 0, "pass"),
        (samples(rate_hz=190.0), 0, "pass"),
        (samples(rate_hz=100.0), 0, "fail"),
        (samples(gap_at=300, gap_ms=8.0), 0, "warn"),
        (samples(gap_at=300, gap_ms=30.0), 0, "fail"),
        (samples(), 2, "warn"),
        (samples(angle=int(210 / 180 * 32768)), 0, "fail"),
        ([s._replace(angle_counts=10 * i) for i, s in enumerate(samples())], 0, "warn"),
    ],
)
def test_an_inclinometer_by_its_samples(bench, heard_samples, rejected, verdict):
    check = judge_samples(bench(), heard_samples, rejected)
    assert check.verdict == verdict, check.found
    assert bool(check.do) == (verdict != "pass")


def test_a_wrong_rate_is_no_failure_where_each_run_sets_it(bench):
    text = "[inclinometer]\nconfigure = true\n"
    assert judge_samples(bench(text), samples(rate_hz=100.0), 0).verdict == "warn"
    assert _nothing_usable(bench(text).inclinometer, 500).verdict == "warn"
    assert _nothing_usable(bench(text).inclinometer, 0).verdict == "fail"
    assert _nothing_usable(bench().inclinometer, 500).verdict == "fail"


# --- what is simulated


def test_what_is_simulated_and_what_is_real(bench):
    assert bus_is_simulated(bench(), "can0")
    assert inclinometer_is_simulated(bench())
    assert not is_real(bench())
    assert bus_is_simulated(bench(base="slcan"), "valve_bus")
    assert not is_real(bench(base="slcan"))
    assert is_real(bench(base="real"))
    mixed = bench('[inclinometer]\nport = "/dev/ttyUSB0"\n')
    assert is_real(mixed)
    assert not inclinometer_is_simulated(mixed)
    assert bus_is_simulated(mixed, "can0")


# --- several hosts

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


# --- what a person and a log get


def test_lines_say_the_verdict_what_was_found_and_what_to_do(bench):
    checks = [Check("one", "pass", "good"), Check("number two", "fail", "bad\nvery", "mend it")]
    said = lines(bench(), checks)
    assert said[:4] == ["pass  one         good", "fail  number two  bad", " " * 18 + "very", " " * 18 + "-> mend it"]
    assert said[-1].endswith(": fail")


def test_a_certificate_goes_into_the_log_of_its_bench_and_of_no_other(bench, tmp_path):
    file = tmp_path / "c.json"
    file.write_text(json.dumps(certified(bench(), [Check("one", "warn", "so so", "mend", {"x": 1.0})])))
    assert read_certificate(file)["verdict"] == "warn"
    run_dir = tmp_path / "run"
    run_dir.mkdir()
    keep_certificate(run_dir, bench())
    assert not (run_dir / CERTIFICATE_FILE).exists()
    keep_certificate(run_dir, bench(f'[run]\ncertificate = "{file}"\n'))
    assert json.loads(attachments_of(run_dir)[CERTIFICATE_FILE])["checks"][0]["measured"] == {"x": 1.0}
    other = bench(f'[run]\ncertificate = "{file}"\n').model_copy(update={"name": "other"})
    with pytest.raises(BadConfig, match="is the certificate of bench 'examined', and this is 'other'"):
        keep_certificate(run_dir, other)


@pytest.mark.parametrize("content", [None, "", "[1]", '{"bench": "b"}', "\udcff"])
def test_what_is_no_certificate_is_said(tmp_path, content):
    file = tmp_path / "c.json"
    if content is not None:
        file.write_bytes(content.encode(errors="surrogateescape"))
    with pytest.raises(BadFile, match=r"c\.json: "):
        read_certificate(file)
