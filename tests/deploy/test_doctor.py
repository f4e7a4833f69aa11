"""What the doctor makes of what it sees: each verdict on made-up findings, on both sides of its limit."""

import json

import pytest

from softloop.deploy import doctor_host
from softloop.deploy.doctor import certified, lines, timing
from softloop.deploy.doctor_check import Check, judged, worst
from softloop.deploy.doctor_clock import clock, clock_source, day_error_ms
from softloop.deploy.rotate import MIB, RunFolder
from softloop.deploy.run_dir import CERTIFICATE_FILE, keep_certificate, read_certificate
from softloop.devices.protocols import can_frames
from softloop.watch.config import RecorderConfig
from softloop.wire.errors import BadConfig, BadFile
from softloop.wire.mcap_layout import attachments_of

MS = 1_000_000
AT = can_frames.VALVE_STATUS_ID


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
    flush_s = bench().recorder.flush_s
    for worst_s, verdict in ((0.9 * flush_s, "pass"), (1.1 * flush_s, "warn"), (held_s + 1, "fail")):
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
