"""A log's inputs through its controller again: equal bits, or the first tick and field that differ."""

import json
from dataclasses import replace as with_fields
from itertools import pairwise

import numpy as np
import pytest
import replay_runs as runs
import synthetic
from typer.testing import CliRunner

from softloop.controller.config import ArcConfig, ControllerConfig
from softloop.controller.records import IN_MODE_TICKS, PHASE_APPROACH, PHASE_DONE, PHASE_TRACK, PHASE_WAIT
from softloop.deploy import cli
from softloop.dynamics.parameters import load_parameters, shipped
from softloop.offline import replay as replay_module
from softloop.offline.log import open_log
from softloop.offline.replay import installation_differences, replay
from softloop.offline.replay_log import read_run
from softloop.wire.errors import BadConfig, BadFile

ARC = runs.CONFIGS["arc"]
LAWS = list(runs.CONFIGS)


@pytest.fixture(scope="module")
def made():
    """Law -> the messages of its run."""
    return {law: runs.made_run(config) for law, config in runs.CONFIGS.items()}


@pytest.fixture
def replayed(tmp_path):
    """Write messages as a log and replay it."""

    def write_and_replay(messages, config=ARC, other=None, **options):
        return replay(open_log(runs.write_run(tmp_path / "run", messages, config, **options)), other)

    return write_and_replay


def cycles_of(messages):
    kind = runs.message("CycleRecord")
    return [kind.unpack(p) for name, p in messages if name == "cycle"]


@pytest.mark.parametrize("law", LAWS)
def test_the_made_up_run_has_what_happens_at_wall_pace(made, law):
    cycles = cycles_of(made[law])
    phases = [c.phase for c in cycles]
    assert [p for k, p in enumerate(phases) if k == 0 or p != phases[k - 1]] == [
        PHASE_WAIT, PHASE_APPROACH, PHASE_TRACK, PHASE_WAIT, PHASE_APPROACH, PHASE_TRACK,
    ]  # fmt: skip
    assert sum(c.skipped > 0 for c in cycles) > 3
    assert sum(not c.inputs_valid for c in cycles[20:]) > 5
    assert sum(a.pressure_seq == b.pressure_seq for a, b in pairwise(cycles)) > 20
    assert len({c.mode for c in cycles}) == 3


@pytest.mark.parametrize("law", LAWS)
def test_a_run_replays_to_the_bit(made, replayed, law):
    result = replayed(made[law], runs.CONFIGS[law])
    assert result.equal
    assert (result.law, result.ticks, result.compared, result.commands) == (law, 500, 500, 500)
    assert (result.differing, result.stretches, result.restarts, result.absent) == ({}, [], [], [])
    assert max(result.deviation.maximum.values()) == 0.0


def test_blocks_of_ticks_make_no_difference(made, tmp_path, monkeypatch):
    monkeypatch.setattr(replay_module, "BLOCK", 37)
    done = []
    log = open_log(runs.write_run(tmp_path, made["arc"], ARC))
    result = replay(log, None, lambda n, total: done.append((n, total)))
    assert result.equal
    assert result.compared == 500
    assert done[-1] == (500, 500)
    assert len(done) == 14


def test_the_end_of_a_run_replays_too(replayed, tmp_path):
    reference = tmp_path / "short.csv"
    reference.write_text("t_s,value\n" + "".join(f"{0.1 * k},60.0\n" for k in range(12)))
    config = ControllerConfig(law="pid", trajectory=str(reference), approach_s=0.1)
    messages = runs.made_run(config)
    assert cycles_of(messages)[-1].phase == PHASE_DONE
    assert replayed(messages, config).equal
    ended = replayed(runs.without(messages, "cycle", lambda m: m.seq < 490), config)
    assert (ended.equal, ended.compared) == (True, 10)


@pytest.mark.parametrize(
    ("field", "change", "said"),
    [
        ("s2_kpa", lambda m: np.nextafter(m.s2_kpa, np.inf), "s2_kpa"),
        ("mode", lambda m: m.mode % 3 + 1, "mode"),
        ("theta", lambda m: (*m.theta[:5], m.theta[5] + 1.0, *m.theta[6:]), "theta[5]"),
        ("internal", lambda m: (*m.internal[:15], -0.0), "internal[15]"),
        ("error_deg", lambda m: np.nan, "error_deg"),
        ("pressure_age_ns", lambda m: m.pressure_age_ns + 1, "pressure_age_ns"),
    ],
)
def test_a_changed_field_is_found_with_its_tick_and_name(made, replayed, field, change, said):
    at = cycles_of(made["arc"])[320]
    result = replayed(runs.changed(made["arc"], "cycle", **{field: lambda m: change(m) if m.seq == at.seq else None}))
    assert not result.equal
    assert (result.first.tick, result.first.record, result.first.field) == (at.tick, 320, said)
    assert result.differing == {field: 1}


def test_nan_is_equal_to_nan(made, replayed):
    """The pressure law's records hold NaN where an angle has no meaning; another NaN is no difference."""
    other_nan = np.array([0xFFF8000000000001], np.uint64).view(float)[0]
    result = replayed(runs.changed(made["pressure"], "cycle", reference_deg=lambda m: other_nan), runs.CONFIGS["pressure"])
    assert result.equal


@pytest.mark.parametrize("field", ["charge_current_ma", "exhaust_current_ma", "mode", "ready"])
def test_a_changed_command_is_found(made, replayed, field):
    at = cycles_of(made["arc"])[100]
    result = replayed(runs.changed(made["arc"], "command", **{field: lambda m: 9 if m.seq == at.seq else None}))
    assert (result.first.tick, result.first.field, result.first.logged) == (at.tick, f"command.{field}", 9)


def test_the_first_difference_of_all_fields_is_named(made, replayed):
    messages = runs.changed(made["arc"], "cycle", gate=lambda m: 7 if m.seq == 50 else None)
    messages = runs.changed(messages, "command", mode=lambda m: 9 if m.seq == 40 else None)
    messages = runs.changed(messages, "cycle", skipped_total=lambda m: 999 if m.seq == 60 else None)
    result = replayed(messages)
    assert (result.first.record, result.first.field) == (39, "command.mode")
    assert result.differing == {"gate": 1, "command.mode": 1, "skipped_total": 1}


def test_a_sample_that_was_not_what_the_tick_saw_shows(made, replayed):
    messages = runs.changed(made["arc"], "inclination", rate_deg_s=lambda m: m.rate_deg_s + 1e-9 if m.seq == 200 else None)
    result = replayed(messages)
    first = next(c for c in cycles_of(made["arc"]) if c.inclination_seq == 200)
    assert (result.first.tick, result.first.field) == (first.tick, "rate_deg_s")


@pytest.mark.parametrize("law", LAWS)
def test_missing_records_are_said_and_the_rest_is_compared(made, replayed, law):
    """In waiting, in the approach, over its end, on the trajectory, over the disarm and over the re-arming."""
    gaps = [(5, 6), (8, 30), (50, 52), (60, 90), (120, 140), (142, 165), (300, 300), (400, 450)]
    result = replayed(runs.without(made[law], "cycle", lambda m: any(a <= m.seq <= b for a, b in gaps)), runs.CONFIGS[law])
    assert result.equal
    missing = [last - first + 1 for first, last in gaps]
    assert result.ticks == 500 - sum(missing)
    assert result.compared == result.ticks - len(gaps)
    ticks = [cycles_of(made[law])[last].tick for _, last in gaps]
    assert [(s.first_tick, s.last_tick, s.recorded, s.unrecorded) for s in result.stretches] == [
        (tick, tick, 1, count) for tick, count in zip(ticks, missing, strict=True)
    ]
    assert result.stretches[0].why == "2 cycle records here not in the log"


@pytest.mark.parametrize("begin", [2, 20, 200, 450])
def test_a_log_that_begins_late_is_compared_from_its_second_record_on(made, replayed, begin):
    result = replayed(runs.without(made["arc"], "cycle", lambda m: m.seq < begin))
    assert result.equal
    assert result.compared == 500 - begin
    (stretch,) = result.stretches
    assert stretch.unrecorded == begin - 1
    assert stretch.why.endswith("before the log begins not in the log")


@pytest.mark.parametrize("channel", ["pressure", "inclination", "valves"])
def test_missing_samples_are_said_and_the_rest_is_compared(made, replayed, channel):
    called = "valve" if channel == "valves" else channel
    saw = [k for k, c in enumerate(cycles_of(made["arc"])) if 200 <= getattr(c, f"{called}_seq") < 210]
    result = replayed(runs.without(made["arc"], channel, lambda m: 200 <= m.seq < 210))
    assert result.equal
    assert result.compared == 500 - len(saw)
    (stretch,) = result.stretches
    assert (stretch.recorded, stretch.unrecorded) == (len(saw), 0)
    assert (stretch.first_tick, stretch.last_tick) == tuple(cycles_of(made["arc"])[k].tick for k in (saw[0], saw[-1]))
    assert channel.removesuffix("s") in stretch.why


def test_a_difference_behind_a_missing_stretch_is_still_found(made, replayed):
    messages = runs.without(made["arc"], "cycle", lambda m: 200 <= m.seq < 220)
    result = replayed(runs.changed(messages, "cycle", charge_current_ma=lambda m: -1.0 if m.seq == 300 else None))
    assert (result.first.tick, result.first.field) == (cycles_of(made["arc"])[299].tick, "charge_current_ma")


def test_a_record_that_does_not_hold_the_state_shows_after_a_missing_stretch(made, replayed):
    """What the state is taken from matters: one place of it wrong, and the ticks behind differ."""
    messages = runs.without(made["arc"], "cycle", lambda m: 200 <= m.seq < 220)
    wrong = runs.changed(messages, "cycle", internal=lambda m: (0.0,) * 16 if m.seq == 220 else None)
    result = replayed(wrong)
    assert result.first.record == 200
    assert cycles_of(made["arc"])[219].internal[IN_MODE_TICKS] != 0.0


def test_missing_commands_are_counted(made, replayed):
    result = replayed(runs.without(made["arc"], "command", lambda m: m.seq > 490))
    assert result.equal
    assert (result.compared, result.commands) == (500, 490)


def test_a_controller_that_was_started_again_begins_anew(made, replayed):
    """Its numbers begin again at 1, and so may a sender's: what tells samples apart is number and stamp."""
    again = runs.made_run(ARC, 300, start_ns=runs.START_NS + 10_000 * runs.PERIOD_NS)
    result = replayed(made["arc"] + again)
    assert result.equal
    assert (result.compared, result.commands, result.restarts) == (800, 800, [0])
    late = replayed(made["arc"] + runs.without(again, "cycle", lambda m: m.seq < 41))
    assert (late.equal, late.compared, late.stretches[0].unrecorded) == (True, 500 + 259, 40)


def test_the_parameters_in_the_log_count_and_not_those_of_today(replayed, tmp_path):
    of_the_log = shipped().read_text().replace("volume_m3 = ", "volume_m3 = 1.1")
    (tmp_path / "other.toml").write_text(of_the_log)
    parameters = load_parameters(tmp_path / "other.toml")
    assert parameters != load_parameters(shipped())
    messages = runs.made_run(ARC, 200, parameters=parameters)
    assert replayed(messages, parameters=of_the_log.encode()).equal
    assert not replayed(messages).equal


def test_other_gains_and_another_law_are_measured_against_the_log(made, replayed):
    same = replayed(made["arc"], other=ARC)
    assert same.equal
    assert same.deviation.ticks == sum(c.phase in (PHASE_APPROACH, PHASE_TRACK) for c in cycles_of(made["arc"]))
    softer = replayed(made["arc"], other=ARC.model_copy(update={"arc": ArcConfig(k2=20.0)}))
    assert softer.deviation.rms("desired_pressure_kpa") >= 0.0
    assert 0.0 < softer.deviation.rms("charge_current_ma") <= softer.deviation.maximum["charge_current_ma"]
    pid = replayed(made["arc"], other=runs.CONFIGS["pid"])
    assert pid.law == "pid"
    assert pid.deviation.maximum["desired_pressure_kpa"] > 1.0
    assert 0.0 < pid.deviation.other_mode_share < 1.0


def test_another_controller_joins_a_run_under_way_where_the_run_is(made, replayed):
    whole = replayed(made["arc"], other=runs.CONFIGS["pid"])
    late = replayed(runs.without(made["arc"], "cycle", lambda m: m.seq < 300), other=runs.CONFIGS["pid"])
    assert whole.differing.get("trajectory_ns", 0) == late.differing.get("trajectory_ns", 0) == 0
    assert late.compared == 200


def test_a_pressure_law_cannot_answer_a_log_of_angles(made, replayed):
    with pytest.raises(BadConfig, match="one follows a pressure, one an angle"):
        replayed(made["arc"], other=runs.CONFIGS["pressure"])


@pytest.mark.parametrize(
    ("channel", "options", "said"),
    [
        ("cycle", {}, "it holds no cycle record"),
        (None, {"leave_out": ("bench.toml",)}, "it has no bench.toml attached"),
        (None, {"leave_out": ("parameters.toml",)}, "it has no parameters.toml attached"),
        (None, {"parameters": b"[bending"}, "parameters.toml: not valid TOML"),
        (None, {"parameters": b"\xff"}, "parameters.toml: not valid TOML"),
        ("pressure", {}, "none of its 500 ticks can be compared"),
    ],
)
def test_a_log_that_cannot_be_replayed_says_why(made, replayed, channel, options, said):
    messages = runs.without(made["arc"], channel, lambda m: m.seq != 1 or channel == "cycle") if channel else made["arc"]
    if channel == "pressure":
        messages = runs.changed(messages, "cycle", pressure_stamp_ns=lambda m: m.pressure_stamp_ns + 1)
    with pytest.raises(BadFile, match=said):
        replayed(messages, **options)


def test_a_log_of_another_layout_is_compared_in_what_it_has(made, tmp_path):
    log = open_log(runs.write_run(tmp_path, made["arc"], ARC))
    names = [n for n in log["cycle"].dtype.names if n != "disturbance_deg_s2"]
    log.channels["cycle"] = log["cycle"][names].copy()
    result = replay(log)
    assert result.equal
    assert result.absent == ["cycle.disturbance_deg_s2"]
    log.channels["cycle"] = log["cycle"][[n for n in names if n != "skipped"]].copy()
    with pytest.raises(BadFile, match="its cycle records have no skipped"):
        read_run(log)


def test_another_installation_is_named(made, tmp_path):
    log = open_log(runs.write_run(tmp_path, made["arc"][:50], ARC))
    assert installation_differences(log) == []
    found = json.loads(log.attachments["versions.json"]) | {"numba": "0.1", "cpu": "abacus", "python": "2.7"}
    log = with_fields(log, attachments=log.attachments | {"versions.json": json.dumps(found).encode()})
    assert [line.split(", here")[0] for line in installation_differences(log)] == ["numba: log 0.1", "cpu: log abacus"]


def run_cli(*arguments):
    return CliRunner().invoke(cli.app, ["replay", *map(str, arguments)], standalone_mode=False)


def test_the_command_says_equal(made, tmp_path):
    runs.write_run(tmp_path, runs.without(made["arc"], "cycle", lambda m: m.seq == 3), ARC)
    done = run_cli(tmp_path)
    tick = cycles_of(made["arc"])[3].tick
    assert done.return_value == 0
    assert done.stdout.splitlines() == [
        f"tick {tick}: not comparable, state taken from the record: 1 cycle record here not in the log",
        "equal: 498 of 499 ticks and 498 commands compared, bit for bit (law arc)",
    ]


def test_the_command_names_what_differs(made, tmp_path):
    at = cycles_of(made["arc"])[99]
    runs.write_run(tmp_path, runs.changed(made["arc"], "cycle", s1_deg_s=lambda m: np.nan if m.seq == 100 else None), ARC)
    done = run_cli(tmp_path)
    assert done.return_value == 1
    assert done.stdout.splitlines()[0] == f"different at tick {at.tick}: s1_deg_s: logged nan, replayed {at.s1_deg_s!r}"
    told = json.loads(run_cli(tmp_path, "--json").stdout)
    first = {"record": 99, "tick": at.tick, "field": "s1_deg_s", "logged": "nan", "replayed": at.s1_deg_s}
    assert told["first_difference"] == first
    assert (told["equal"], told["compared"], told["differing_ticks"]) == (False, 500, {"s1_deg_s": 1})


def test_the_command_measures_another_controller(made, tmp_path):
    runs.write_run(tmp_path, made["arc"], ARC)
    bench = tmp_path / "pid.toml"
    bench.write_text('name = "b"\n[controller]\nlaw = "pid"\ntrajectory = "t2"\n')
    done = run_cli(tmp_path, "--controller", bench)
    assert done.return_value == 0
    assert done.stdout.startswith("the two follow different trajectories: approach_s 0.3 and 4.0\n")
    assert "law pid on the log's inputs" in done.stdout
    assert "% of the ticks" in done.stdout
    told = json.loads(run_cli(tmp_path, "--controller", bench, "--json").stdout)
    assert told["own_controller"] is False
    assert told["deviation"]["charge_current_ma_max"] > 0.0


@pytest.mark.parametrize("what", ["no file", "not MCAP", "no controller", "no bench"])
def test_a_bad_file_is_exit_code_2(made, tmp_path, capsys, what):
    log = tmp_path / "run.mcap"
    arguments = [str(log)]
    if what == "not MCAP":
        log.write_bytes(b"nothing of the kind")
    if what == "no controller":
        synthetic.write_log(log, [m for m in synthetic.messages(0.1) if m[0] != "cycle"])
    if what == "no bench":
        runs.write_run(tmp_path, made["arc"][:50], ARC)
        arguments += ["--controller", str(tmp_path / "nowhere.toml")]
    with pytest.raises(SystemExit) as caught:
        cli.main(["replay", *arguments])
    assert caught.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
