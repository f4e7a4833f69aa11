"""Scenario files: what is refused and how it is said, and the bench that one makes."""

import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from softloop.deploy.bench import find_bench, load_bench
from softloop.deploy.scenario import (
    HOST_KINDS,
    PLANT_KINDS,
    Scenario,
    find_scenario,
    load_scenario,
    shipped_scenarios,
    write_bench,
)
from softloop.wire.benchfile import load_model
from softloop.wire.errors import BadConfig, BadFile, SoftloopError

GOOD = """
name = "one"
description = "What happens."
pace = "lockstep"
duration_s = 3.0
expected = "VENT"
[overrides.run]
settle_s = 0.4
[[injections]]
kind = "power_loss"
at_s = 2.0
[[injections]]
kind = "serial_drop"
target = "inclinometer"
at_s = 1.0
duration_s = 0.5
"""


@pytest.fixture
def bench(tmp_path):
    """A function that gives the bench of a scenario's text on a shipped one."""

    def make(text, base="sim", **changes):
        path = tmp_path / "s.toml"
        path.write_text(text)
        write_bench(load_scenario(path), path, find_bench(Path(base)), tmp_path / "bench.toml", changes)
        return load_bench(tmp_path / "bench.toml", tmp_path)

    return make


def test_injections_go_where_they_are_carried_out(bench):
    made = bench(GOOD)
    assert (made.pace.mode, made.run.duration_s, made.plant.faults_from) == ("lockstep", 3.0, "start")
    assert [(f.kind, f.on_s) for f in made.plant.faults] == [("power_loss", 2.4)]
    assert [(i.kind, i.at_s, i.duration_s) for i in made.faults.injections] == [("serial_drop", 1.0, 0.5)]


def test_by_the_clock_faults_of_the_rig_count_from_arming(bench):
    made = bench(GOOD.replace('pace = "lockstep"\n', ""))
    assert (made.pace.mode, made.plant.faults_from, made.plant.faults[0].on_s) == ("wall", "armed", 2.0)


@pytest.mark.parametrize(("old", "new", "said"), [
    ('name = "one"', 'name = "one"\nnames = 1', "unknown key 'names'; allowed here: bench, description, duration_s, expected,"),
    ("at_s = 2.0", "at_s = 2.0\nat = 1.0", "unknown key 'injections.0.at'; allowed here: at_s, duration_s, kind,"),
    ('expected = "VENT"', 'expected = "vent"', "'VENT', 'DEAD', 'CONTINUE' or 'TRAPPED'"),
    ('kind = "power_loss"', 'kind = "gremlins"', "no kind 'gremlins'; there are: chamber_bias, "),
    ("at_s = 2.0", "at_s = -2.0", "key 'injections.0.at_s'"),
    ('target = "inclinometer"', 'target = "plant"', "no target 'plant'; it has: inclinometer"),
    ('target = "inclinometer"', "", "no target ''; it has: inclinometer"),
    ('kind = "power_loss"', 'kind = "power_loss"\nsize = 2.0', "kind 'power_loss' has no size"),
    ('kind = "power_loss"', 'kind = "power_loss"\ntarget = "plant"', "has neither target nor probability"),
    ("duration_s = 3.0", "", "key 'duration_s' is missing"),
    ("settle_s = 0.4", "settle = 0.4", "unknown key 'run.settle'"),
    ('kind = "power_loss"', 'kind = "process_kill"\ntarget = "valves"', "kind 'process_kill' needs wall pace"),
    ('kind = "power_loss"', 'kind = "clock_step"\ntarget = "valves"\nsize = 5.0', "kind 'clock_step' needs wall pace"),
    ('kind = "power_loss"', 'kind = "disk_full"\ntarget = "recorder"\nprobability = 0.5', "kind 'disk_full' has no probability"),
])  # fmt: skip
def test_a_mistake_is_one_line_that_names_file_and_key(bench, tmp_path, old, new, said):
    assert GOOD.count(old) == 1
    with pytest.raises(BadConfig) as caught:
        bench(GOOD.replace(old, new))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(tmp_path) in str(caught.value)


def test_what_breaks_the_simulated_rig_is_refused_where_there_is_none(bench):
    with pytest.raises(BadConfig, match="'power_loss' breaks the simulated rig, and this bench has none"):
        bench(GOOD.replace('pace = "lockstep"\n', ""), base="real")


def test_host_side_injections_go_onto_a_bench_of_real_devices(bench):
    text = GOOD.replace('pace = "lockstep"\n', "").replace('[[injections]]\nkind = "power_loss"\nat_s = 2.0\n', "")
    assert len(bench(text, base="real").faults.injections) == 1


def test_shipped_ones_are_good_and_named_as_their_files(tmp_path):
    shipped = shipped_scenarios()
    assert len(shipped) > 30
    for name, path in shipped.items():
        scenario = load_scenario(path)
        assert scenario.name == name
        write_bench(scenario, path, find_bench(Path(scenario.bench)), tmp_path / "bench.toml")
        load_bench(tmp_path / "bench.toml", tmp_path)


def test_every_kind_on_the_hosts_side_stands_in_a_shipped_scenario():
    used = {one.kind for path in shipped_scenarios().values() for one in load_scenario(path).injections}
    assert set(HOST_KINDS) - used == set()


def test_an_unknown_name_lists_the_shipped_ones():
    with pytest.raises(BadFile, match="there is no such scenario file; shipped ones go by name: bus_"):
        find_scenario(Path("nowhere"))


def lines_said(action, *arguments):
    """How many lines an error of ours has; one where there is none. Another error is a failure."""
    try:
        action(*arguments)
    except SoftloopError as error:
        return len(str(error).splitlines())
    return 1


def values():
    return st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=8), st.just([]), st.just({}))


KEYS = ["at_s", "duration_s", "target", "size", "probability", "extra"]


@example("can_drop", {"target": "a\x85b"})
@given(st.sampled_from(PLANT_KINDS + HOST_KINDS), st.dictionaries(st.sampled_from(KEYS), values(), max_size=4))
def test_no_content_of_an_injection_is_more_than_one_line(kind, changed):
    content = tomllib.loads(GOOD)
    content["injections"] = [{"kind": kind, "at_s": 1.0, **changed}]
    assert lines_said(load_model, Scenario, content, "s.toml") == 1


@given(st.text(max_size=200))
def test_no_text_is_more_than_one_line(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "fuzzed.toml"
    path.write_bytes((GOOD[: len(GOOD) // 2] + text).encode("utf-8", "replace"))
    assert lines_said(load_scenario, path) == 1


PAGE = Path(__file__).resolve().parents[2] / "docs" / "faults.md"


def test_the_page_names_every_kind_on_the_hosts_side_and_every_shipped_scenario():
    words = set(re.findall(r"[a-z0-9_]+", PAGE.read_text()))
    assert set(HOST_KINDS) - words == set()
    assert set(shipped_scenarios()) - words == set()


def test_the_pages_example_is_good(bench):
    made = bench(re.search(r"^```toml\n(.*?)^```", PAGE.read_text(), re.S | re.M)[1])
    assert [i.kind for i in made.faults.injections] == ["serial_drop", "process_kill"]
