"""summary.json and the table."""

import io
import json

import pytest
import synthetic
from rich.console import Console

from softloop.offline.log import open_log
from softloop.offline.run_log import find_log
from softloop.offline.summary import MEANINGS, summarise, summary_table, write_summary
from softloop.wire.errors import BadFile


def change(made, name, **values):
    """The same run with fields of one channel changed; a value may be a function of the message."""
    for channel, key, m in made:
        if channel == name:
            m = m._replace(**{k: (v(m) if callable(v) else v) for k, v in values.items()})
        yield channel, key, m


def run_dir(tmp_path, made=None, **options):
    synthetic.write_log(tmp_path / "run.mcap", list(made if made is not None else synthetic.messages(1.0)), **options)
    return tmp_path


@pytest.fixture(scope="module")
def good(long_run):
    return summarise(open_log(long_run / "run.mcap"))


def test_every_figure_has_a_meaning_and_every_meaning_a_figure(good):
    assert set(good) == set(MEANINGS)


def test_names_hold_units(good):
    units = ("_deg", "_s", "_us", "_ms", "_kpa", "_percent", "_per_s")
    for key, value in good.items():
        if isinstance(value, float):
            assert key.endswith(units), key


def test_the_file_is_plain_json_with_the_same_figures(tmp_path):
    found = write_summary(run_dir(tmp_path))
    assert json.loads((tmp_path / "summary.json").read_text()) == found


def test_a_good_run(good):
    assert good["evidence_valid"] is True
    assert good["dwells"] == 6
    assert 0.0 < good["truth_error_steady_deg"] < good["truth_error_max_deg"] < 2.0
    assert good["law"] == "arc"
    assert good["gate_faults"] == 0
    assert good["missing_cycle"] == 0
    assert good["tick_late_p50_us"] == 60.0
    assert good["plant_late_max_ms"] == pytest.approx(0.3)


def test_a_plant_that_was_late_is_no_evidence(tmp_path):
    made = change(synthetic.messages(1.0), "truth", late_max_ns=lambda m: 2_100_000 if m.seq > 50 else 0)
    found = write_summary(run_dir(tmp_path, made))
    assert found["evidence_valid"] is False
    assert found["evidence_problems"] == "the plant was late by 2.1 ms (allowed: 2 ms)"


def test_a_plant_that_was_two_milliseconds_late_is(tmp_path):
    made = change(synthetic.messages(1.0), "truth", late_max_ns=2_000_000)
    assert write_summary(run_dir(tmp_path, made))["evidence_valid"] is True


def test_a_channel_that_falls_silent_is_no_evidence_though_no_number_is_missing(tmp_path):
    made = [m for m in synthetic.messages(4.0) if not (m[0] == "valves" and m[2].seq > 200)]
    found = write_summary(run_dir(tmp_path, made))
    assert found["missing_valves"] == 0
    assert found["silent_channels"].startswith("valves 3.")
    assert found["evidence_valid"] is False


def test_a_missing_cycle_record_could_hide_the_largest_error(tmp_path):
    made = [m for m in synthetic.messages(1.0) if not (m[0] == "cycle" and m[2].seq == 77)]
    found = write_summary(run_dir(tmp_path, made))
    assert found["missing_cycle"] == 1
    assert found["evidence_problems"] == "1 cycle records are missing"


def test_an_unfinished_log_is_said(tmp_path):
    found = write_summary(run_dir(tmp_path, finish=False))
    assert "not finished" in found["log_problems"]
    assert found["evidence_valid"] is False


def test_a_log_without_a_plant_is_judged_by_the_rest(tmp_path):
    made = [m for m in synthetic.messages(1.0) if m[0] != "truth"]
    found = write_summary(run_dir(tmp_path, made))
    assert found["truth_error_max_deg"] is None
    assert found["sensor_error_max_deg"] > 0.0
    assert found["latency_pressure_total_p50_us"] is None
    assert found["latency_pressure_to_bus_p50_us"] > 0.0
    assert found["evidence_valid"] is True


def test_a_run_that_never_tracked(tmp_path):
    found = write_summary(run_dir(tmp_path, change(synthetic.messages(1.0), "cycle", phase=0)))
    assert found["truth_error_max_deg"] is None
    assert found["evidence_problems"].startswith("nothing was tracked")
    Console(file=io.StringIO()).print(summary_table(found))


def test_an_empty_log(tmp_path):
    found = write_summary(run_dir(tmp_path, []))
    assert found["messages"] == 0
    Console(file=io.StringIO()).print(summary_table(found))


def test_faults_and_their_reasons(tmp_path):
    made = change(synthetic.messages(1.0), "event", code=2, reason=lambda m: 2 if m.seq == 1 else 5)
    found = write_summary(run_dir(tmp_path, made))
    assert (found["gate_faults"], found["gate_fault_reasons"]) == (2, "sensor_stale; over_pressure")


def test_a_law_that_follows_a_pressure_has_pressure_errors_only(tmp_path):
    nan = float("nan")
    made = change(synthetic.messages(6.0), "cycle", reference_deg=nan, reference_rate_deg_s=nan)
    found = write_summary(run_dir(tmp_path, made))
    assert found["truth_error_max_deg"] is None
    assert found["pressure_error_max_kpa"] == pytest.approx(1.0, abs=0.2)  # truth is stamped 1 ms before the tick


def test_what_the_recorder_dropped_is_taken_from_its_account(tmp_path):
    run_dir(tmp_path)
    (tmp_path / "recorder.json").write_text('{"dropped_backlog": 3, "dropped_storage": 2, "malformed": 1}')
    assert write_summary(tmp_path)["recorder_dropped"] == 6
    (tmp_path / "recorder.json").write_text("[]")
    assert write_summary(tmp_path)["recorder_dropped"] is None


def test_the_table_shows_the_papers_figure_and_the_verdict(good):
    stream = io.StringIO()
    Console(file=stream, width=140).print(summary_table(good))
    text = stream.getvalue()
    assert "4.36" in text
    assert "0.82" in text
    assert "valid evidence" in text


def test_without_dwells_the_run_is_measured_against_the_second_test(tmp_path):
    found = summarise(open_log(synthetic.write_log(tmp_path / "run.mcap", list(synthetic.messages(3.0, moving=True)))))
    stream = io.StringIO()
    Console(file=stream, width=140).print(summary_table(found))
    assert found["dwells"] == 0
    assert "3.67" in stream.getvalue()


def test_the_log_of_a_directory(tmp_path):
    with pytest.raises(BadFile, match=r"holds one \.mcap log; here: none"):
        find_log(tmp_path)
    (tmp_path / "a.mcap").touch()
    assert find_log(tmp_path) == tmp_path / "a.mcap"
    (tmp_path / "b.mcap").touch()
    with pytest.raises(BadFile, match=r"a\.mcap, b\.mcap"):
        find_log(tmp_path)
