"""Two runs of one excitation against bounds."""

import json
import subprocess
import sys

import pytest
import synthetic
from hypothesis import given, settings
from hypothesis import strategies as st
from test_report import Page

from softloop.deploy.parity import judge_parity
from softloop.offline.parity import SIGNALS
from softloop.offline.parity_bounds import EstimateConfig, ParityBounds, load_bounds
from softloop.wire.benchfile import load_model
from softloop.wire.errors import BadConfig, BadFile

SECONDS = 16.0
BOUNDS = """
[estimate]
segment_s = 5.0
[angle]
residual_rms_max_deg = 1.5
coherence_min = 0.99
delay_max_ms = 2.0
gain_error_max_percent = 3.0
[chamber_pressure]
residual_rms_max_kpa = 1.0
gain_error_max_percent = 3.0
"""


def changed(name, **changes):
    """The messages of a run, those of one channel changed: field -> function of its value."""
    for channel, full_key, value in synthetic.messages(SECONDS, moving=True, seed=3):
        new = {field: change(getattr(value, field)) for field, change in changes.items()} if channel == name else {}
        yield channel, full_key, value._replace(**new) if new else value


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Name -> directory: the run that is the measure, and others that differ in one thing."""
    folder = tmp_path_factory.mktemp("parity")
    made = {
        "measure": synthetic.messages(SECONDS, moving=True, seed=1),
        "same": synthetic.messages(SECONDS, moving=True, seed=2),
        "late": changed("inclination", stamp_ns=lambda ns: ns + 12_000_000),
        "loud": changed("pressure", chamber_pressure_kpa=lambda kpa: 1.1 * kpa),
        "still": changed("inclination", angle_deg=lambda _: 60.0),
        "dwells": synthetic.messages(SECONDS, moving=False, seed=1),
        "short": synthetic.messages(8.0, moving=True, seed=1),
        "half": (one for i, one in enumerate(synthetic.messages(SECONDS, moving=True)) if one[0] != "pressure" or i < 9000),
    }
    for name, messages in made.items():
        (folder / name).mkdir()
        synthetic.write_log(folder / name / "run.mcap", list(messages))
    (folder / "bounds.toml").write_text(BOUNDS)
    return folder


def judged(runs, name, tmp_path, capsys):
    """Exit code and JSON answer."""
    code = judge_parity(runs / "measure", runs / name, runs / "bounds.toml", tmp_path / "out", as_json=True)
    return code, json.loads(capsys.readouterr().out)


def reasons(answer):
    return {name: one["reasons"] for name, one in answer["channels"].items() if one["reasons"]}


def test_the_same_rig_passes_and_leaves_a_page(runs, tmp_path, capsys):
    code, answer = judged(runs, "same", tmp_path, capsys)
    assert (code, answer["passed"], reasons(answer)) == (0, True, {})
    assert set(answer["channels"]) == {one.name for one in SIGNALS}
    assert abs(answer["channels"]["angle"]["delay_ms"]) < 1.0
    files = {f"parity_{what}.{ending}" for what in ("channels", "spectra") for ending in ("svg", "png")}
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"parity.html", *files}
    page = (tmp_path / "out" / "parity.html").read_text()
    assert Page(page).tags.count("img") == 2
    assert "B is within the bounds." in page


def test_a_late_sensor_fails_by_its_delay(runs, tmp_path, capsys):
    code, answer = judged(runs, "late", tmp_path, capsys)
    assert code == 1
    assert list(reasons(answer)) == ["angle"]
    assert answer["channels"]["angle"]["delay_ms"] == pytest.approx(12.0, abs=1.0)
    assert any(line.startswith("delay +1") and line.endswith("B trails A") for line in reasons(answer)["angle"])
    assert "not within the bounds" in (tmp_path / "out" / "parity.html").read_text()


def test_a_sensor_of_another_gain_fails_by_its_gain(runs, tmp_path, capsys):
    code, answer = judged(runs, "loud", tmp_path, capsys)
    assert code == 1
    assert list(reasons(answer)) == ["chamber_pressure"]
    assert answer["channels"]["chamber_pressure"]["gain"] == pytest.approx(1.1, abs=0.01)


def test_what_is_bounded_and_cannot_be_estimated_fails(runs, tmp_path, capsys):
    code, answer = judged(runs, "still", tmp_path, capsys)
    assert code == 1
    assert sum("cannot be estimated" in line for line in reasons(answer)["angle"]) == 3


def test_the_table_names_channel_and_reason(runs, tmp_path, capsys):
    assert judge_parity(runs / "measure", runs / "late", runs / "bounds.toml", tmp_path, as_json=False) == 1
    said = capsys.readouterr().out
    assert "angle: delay +1" in said
    assert "no parity; page:" in said


@pytest.mark.parametrize(
    ("name", "error", "said"),
    [
        ("dwells", BadConfig, "not runs of one excitation: reference_deg differs by up to"),
        ("short", BadConfig, "have 7.9 s of their trajectory in common"),
        ("half", BadFile, "pressure.chamber_pressure_kpa was not measured over the whole trajectory"),
        ("nowhere", BadFile, "nowhere"),
    ],
)
def test_what_does_not_compare_is_refused_in_one_line(runs, tmp_path, name, error, said):
    with pytest.raises(error, match=said) as raised:
        judge_parity(runs / "measure", runs / name, runs / "bounds.toml", tmp_path / "out", as_json=True)
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "out").exists()


def test_the_command_line_gives_the_code_and_one_line_on_an_error(runs, tmp_path):
    words = [sys.executable, "-m", "softloop.deploy.cli", "parity", str(runs / "measure"), "--out", str(tmp_path / "out")]
    for name, code in (("same", 0), ("loud", 1), ("dwells", 2)):
        command = [*words, str(runs / name), "--bounds", str(runs / "bounds.toml")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == code, done.stderr
        assert len(done.stderr.splitlines()) == (code == 2)


def test_another_law_is_another_excitation(runs, tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "BENCH_TOML", b'name = "other"\n[controller]\nlaw = "pid"\n')
        synthetic.write_log(tmp_path / "run.mcap", list(synthetic.messages(SECONDS, moving=True)))
    with pytest.raises(BadConfig, match="their laws are 'arc' and 'pid'"):
        judge_parity(runs / "measure", tmp_path / "run.mcap", runs / "bounds.toml", tmp_path / "out", as_json=True)


def test_the_shipped_bounds_judge_and_can_be_estimated():
    bounds = load_bounds(None)
    assert bounds.angle.judges
    assert bounds.chamber_pressure.judges


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no channel has a bound"),
        ("[angle]\ndelay_max = 2.0\n", "unknown key 'angle.delay_max'; allowed here: coherence_min, delay_max_ms"),
        ("[angel]\n", "unknown key 'angel'; allowed here: angle, chamber_pressure"),
        ("[angle]\ncoherence_min = 1.5\n", "key 'angle.coherence_min'"),
        ("[angle]\nresidual_rms_max_kpa = 1.5\n", "unknown key 'angle.residual_rms_max_kpa'"),
        ("[estimate]\nsegment_s = 1.0\ndelay_max_s = 0.8\n[angle]\ncoherence_min = 0.5\n", "at most half of segment_s"),
        ("[angle\n", "not valid TOML"),
    ],
)
def test_a_wrong_file_of_bounds_is_said_in_one_line(tmp_path, text, said):
    file = tmp_path / "bounds.toml"
    file.write_text(text)
    with pytest.raises((BadConfig, BadFile)) as raised:
        load_bounds(file)
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)
    with pytest.raises(BadFile, match="no such file of bounds"):
        load_bounds(tmp_path / "nowhere.toml")


_VALUES = st.one_of(st.floats(), st.integers(), st.text(max_size=5), st.booleans(), st.lists(st.floats(), max_size=2))
_TABLES = st.dictionaries(
    st.sampled_from([*ParityBounds.model_fields, "other"]),
    st.dictionaries(st.sampled_from(["coherence_min", "delay_max_ms", "segment_s", "excited_db", "x"]), _VALUES, max_size=3),
    max_size=3,
)


@given(_TABLES)
@settings(max_examples=200, deadline=None)
def test_any_content_is_taken_or_refused_in_one_line(content):
    try:
        bounds = load_model(ParityBounds, content, "bounds.toml")
    except BadConfig as error:
        lines = str(error).splitlines()
        if len(lines) != 1:
            pytest.fail(f"{len(lines)} lines: {error}")
    else:
        assert any(bounds.of(one.name).judges for one in SIGNALS)
        assert isinstance(bounds.estimate, EstimateConfig)
