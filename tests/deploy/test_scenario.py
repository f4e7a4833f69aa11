"""Scenario files: what is refused and how it is said, and the bench that one makes."""

import copy
import re
import tomllib
from pathlib import Path

import pytest
import tomlkit
from hypothesis import example, given
from hypothesis import strategies as st

from softloop.deploy.bench import find_bench, load_bench
from softloop.deploy.scenario import (
    HOST_KINDS,
    PLANT_KINDS,
    Scenario,
    bench_of,
    find_scenario,
    load_scenario,
    make_bench,
    shipped_scenarios,
    write_bench,
)
from softloop.plant.config import FAULT_SIZES
from softloop.wire.benchfile import load_model
from softloop.wire.errors import BadConfig, BadFile, SoftloopError
from softloop.wire.fault_config import SIZED, TARGETS

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
    ("settle_s = 0.4", "settle = 0.4", "unknown key 'overrides.run.settle'"),
    ("settle_s = 0.4", "settle_s = 0.4\nduration_s = -1", "key 'overrides.run.duration_s': "),
    ("[overrides.run]", "[overrides]\nrun = 5\n[overrides.page]", "key 'overrides.run': "),
    ("[overrides.run]", "[overrides.valves]\ncan = 'can7'\n[overrides.run]", "key 'overrides.valves.can': there is no "),
    ("[overrides.run]", "[overrides.valves]\nangle_min_deg = 300.0\n[overrides.run]", "key 'overrides.valves': angle_min_deg"),
    ('kind = "power_loss"', 'kind = "process_kill"\ntarget = "valves"',
     "key 'injections.0': kind 'process_kill' needs wall pace"),
    ('kind = "serial_drop"\ntarget = "inclinometer"', 'kind = "bus_babble"\ntarget = "first"',
     "key 'injections.1': kind 'bus_babble' needs a [can.NAME.emulation]"),
    ("at_s = 2.0", "at_s = 50", "key 'injections.0.at_s': the run is over by then: armed for 3 s, vented in 3 s at most; let it"),
    ("at_s = 1.0", "at_s = 50", "key 'injections.1.at_s': the run is over by then"),
    ("at_s = 2.0", "at_s = 2e9", "key 'injections.0.at_s': Input should be less than or equal to 100000000"),
    ("settle_s = 0.4", "settle_s = 1e10", "key 'injections.0.at_s': Input should be less than or equal to 1000000000"),
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


@pytest.mark.parametrize(("old", "new"), [
    ('target = "inclinometer"', 'target = "plant"'),
    ('kind = "power_loss"', 'kind = "hose_burst"'),
    ('kind = "power_loss"', 'kind = "can_delay"\ntarget = "analog"'),
])  # fmt: skip
def test_an_injection_that_is_refused_is_not_missed_besides(bench, old, new):
    head, *both = GOOD.split("[[injections]]")
    alone = next(one for one in both if old in one)
    with pytest.raises(BadConfig) as caught:
        bench(f"{head}[[injections]]{alone.replace(old, new)}")
    assert str(caught.value).count("key '") == 1
    assert "at least 1 item" not in str(caught.value)


def test_a_router_that_is_not_the_runs_own_is_not_lost(bench):
    text = GOOD.replace('pace = "lockstep"\n', "").replace('kind = "power_loss"', 'kind = "router_loss"')
    with pytest.raises(BadConfig, match=r"s\.toml: key 'injections\.0': kind 'router_loss' needs \[run\] shared_router = true"):
        bench(text)
    assert bench(text.replace("settle_s = 0.4", "shared_router = true")).run.shared_router


def test_lockstep_on_a_real_bench_is_said_of_the_scenarios_pace(bench):
    text = GOOD.replace('[[injections]]\nkind = "power_loss"\nat_s = 2.0\n', "")
    with pytest.raises(BadConfig, match=r"s\.toml: key 'pace': lockstep needs the tables"):
        bench(text, base="real")


def test_no_injection_at_all_is_refused():
    with pytest.raises(BadConfig, match="key 'injections': Tuple should have at least 1 item"):
        load_model(Scenario, {**tomllib.loads(GOOD), "injections": []}, "s.toml")


@pytest.mark.parametrize(("pace", "last", "late"), [("lockstep", 6.004, 6.006), ("wall", 10.9, 11.0)])
@pytest.mark.parametrize("old", ["at_s = 2.0", "at_s = 1.0"])
def test_what_comes_while_the_rig_vents_is_taken_and_what_comes_after_its_end_is_not(bench, pace, last, late, old):
    text = GOOD.replace('"lockstep"', f'"{pace}"')
    bench(text.replace(old, f"at_s = {last}"))
    with pytest.raises(BadConfig, match="the run is over by then: armed for 3 s, vented in 3 s"):
        bench(text.replace(old, f"at_s = {late + 0.01}"))


def test_a_run_that_may_wait_for_its_router_has_no_end_that_is_known(bench):
    text = GOOD.replace('pace = "lockstep"\n', "").replace("at_s = 2.0", "at_s = 50")
    assert bench(text.replace("settle_s = 0.4", "shared_router = true")).plant.faults[0].on_s == 50


def test_what_only_the_bench_has_is_said_with_the_bench(bench, tmp_path):
    (tmp_path / "can.toml").write_text('base = "sim.toml"\n[valves]\ndriver = "canopen_current"\n[valves.canopen_current]\n')
    (tmp_path / "sim.toml").write_text(find_bench(Path("sim")).read_text())
    with pytest.raises(BadConfig) as caught:
        bench(GOOD, base=tmp_path / "can.toml")
    said = f"{tmp_path}/s.toml: with the bench {tmp_path}/can.toml: key 'valves.driver': must be \"rig\" at lockstep pace"
    assert str(caught.value).startswith(said)


def test_a_bench_that_is_wrong_by_itself_is_named_by_its_own_file(bench, tmp_path):
    (tmp_path / "wrong.toml").write_text(f'base = "{find_bench(Path("sim"))}"\n[valves]\ncan = "can7"\n')
    with pytest.raises(BadConfig) as caught:
        bench(GOOD, base=tmp_path / "wrong.toml")
    assert str(caught.value).startswith(f"{tmp_path}/wrong.toml: key 'valves")


def test_injections_of_the_bench_itself_keep_their_places(bench, tmp_path):
    own = '[[faults.injections]]\nkind = "can_drop"\ntarget = "analog"\nat_s = 0.5\n'
    own += '[[plant.faults]]\nkind = "angle_stuck"\non_s = 1.0\n'
    (tmp_path / "own.toml").write_text(f'base = "{find_bench(Path("sim"))}"\n{own}')
    made = bench(GOOD, base=tmp_path / "own.toml")
    assert [i.kind for i in made.faults.injections] == ["can_drop", "serial_drop"]
    assert [f.kind for f in made.plant.faults] == ["angle_stuck", "power_loss"]
    for old, key in (("at_s = 2.0", "injections.0.at_s"), ("at_s = 1.0", "injections.1.at_s")):
        with pytest.raises(BadConfig, match=f"s.toml: key '{key}': the run is over"):
            bench(GOOD.replace(old, "at_s = 50"), base=tmp_path / "own.toml")


def test_the_scenarios_overrides_stay_as_they_are(tmp_path):
    scenario = load_model(Scenario, {**tomllib.loads(GOOD), "overrides": {"plant": {"seed": 2}, "can": {"can1": {}}}}, "s.toml")
    before = copy.deepcopy(scenario.overrides)
    assert make_bench(scenario, tmp_path / "s.toml", find_bench(Path("sim")))["plant"]["faults"]
    assert scenario.overrides == before


def test_bench_dir_in_overrides_is_the_scenarios_folder(bench, tmp_path):
    made = bench(GOOD.replace("[overrides.run]", "[overrides.controller]\ntrajectory = '{bench_dir}/my.csv'\n[overrides.run]"))
    assert made.controller.trajectory == f"{tmp_path}/my.csv"


@pytest.mark.parametrize(("name", "said"), [("nowhere", "there is no such bench file"), ("n" * 300, "cannot be looked for")])
def test_a_bench_that_is_not_there_is_said_of_the_scenario(tmp_path, name, said):
    scenario = load_model(Scenario, {**tomllib.loads(GOOD), "bench": name}, "s.toml")
    with pytest.raises(BadFile, match=said) as caught:
        bench_of(scenario, tmp_path / "s.toml")
    assert str(caught.value).startswith(f"{tmp_path}/s.toml: key 'bench': ")


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


def said_by(action, *arguments):
    """What an error of ours says; None where there is none. Another error is a failure."""
    try:
        action(*arguments)
    except SoftloopError as error:
        return str(error)
    return None


def lines_said(action, *arguments):
    """How many lines an error of ours has; one where there is none."""
    return len((said_by(action, *arguments) or "none").splitlines())


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


def mostly(good, odd):
    """Good often enough that what comes behind it is reached too."""
    return st.integers(0, 19).flatmap(lambda n: odd if n == 7 else good)


def tables(*keys):
    """Tables of any of `keys` and any values, some of them tables and lists again."""
    inner = st.recursive(values(), lambda v: st.lists(v, max_size=2) | st.dictionaries(st.sampled_from(INNER), v, max_size=3))
    return st.dictionaries(st.sampled_from(keys), inner, max_size=3)


def numbers(*good):
    """Some that are good, and what a slip of the finger makes of them."""
    odd = st.sampled_from([0, 0.5, 2, 5.5, -1, 50, 1e9, 1e18, 1e300, 10**30]) | st.floats(allow_nan=False)
    return mostly(st.sampled_from(good), odd)


def injections(kind):
    """Those of a kind, mostly such as there can be."""
    targets = TARGETS[kind.partition("_")[0]] if kind in HOST_KINDS else {"": ""}
    sized = kind.partition("_")[2] in SIZED if kind in HOST_KINDS else kind in FAULT_SIZES
    needed = {"size": numbers(0.5, 1)} if sized else {}
    given_all = {"kind": st.just(kind), "target": mostly(st.sampled_from([*targets]), values()), "at_s": numbers(0.5, 1, 1.5)}
    odd = {"size": numbers(0), "probability": numbers(1), "duration_s": numbers(0.2), "extra": values()}
    return mostly(st.fixed_dictionaries(given_all | needed), st.fixed_dictionaries(given_all, optional=odd))


INNER = ["run", "can0", "can", "faults", "injections", "kind", "at_s", "size", "duration_s", "settle_s", "driver", "seed"]
BENCH_TABLES = ["run", "plant", "valves", "can", "faults", "pace", "zenoh", "hosts", "controller", "name", "shadow", "extra"]
GOOD_OVERRIDES = [
    {}, {"run": {"shared_router": True}}, {"valves": {"can": "can7"}}, {"name": "mine"},
    {"plant": {"faults": [{"kind": "angle_stuck", "on_s": 1}]}},
    {"faults": {"injections": [{"kind": "process_kill", "target": "plant", "at_s": 1.0}]}}, {"run": {"settle_s": 1e300}},
    {"can": {"can0": {"emulation": {}}}}, {"plant": {"faults": [{"kind": "angle_stuck", "on_s": 90}]}},
]  # fmt: skip
BENCHES = ["sim", "sim_can", "real", "nowhere", "", ".", "a\x00b", "n" * 300]
scenario_fields = {
    "name": mostly(st.just("one"), values()),
    "description": mostly(st.just("What happens."), values()),
    "duration_s": numbers(2.0, 3),
    "expected": mostly(st.just("VENT"), values()),
    "pace": mostly(st.sampled_from(["wall", "lockstep"]), values()),
    "bench": mostly(st.sampled_from(["sim", "sim_can"]), st.sampled_from(BENCHES) | values()),
    "injections": mostly(
        st.lists(st.sampled_from(PLANT_KINDS + HOST_KINDS).flatmap(injections), min_size=1, max_size=2), values()
    ),
    "overrides": mostly(st.sampled_from(GOOD_OVERRIDES), tables(*BENCH_TABLES) | values()),
    "seed": mostly(st.just(1), st.integers()),
}


def without_none(value):
    """TOML has no null."""
    if isinstance(value, dict):
        return {key: without_none(inner) for key, inner in value.items() if inner is not None}
    return [without_none(inner) for inner in value if inner is not None] if isinstance(value, list) else value


def made_of(path):
    scenario = load_scenario(path)
    write_bench(scenario, path, bench_of(scenario, path), path.with_name("made.toml"))


BARE = {"name": "one", "description": "x", "duration_s": 2.0, "expected": "VENT"}


@example({**BARE, "injections": [{"kind": "process_kill", "target": "valves", "at_s": 1.0}], "pace": "lockstep"})
@example({**BARE, "injections": [{"kind": "can_delay", "target": "analog", "at_s": 1.0}]})
@example({**BARE, "injections": [{"kind": "angle_stuck", "at_s": 50}]})
@given(st.fixed_dictionaries(scenario_fields))
def test_any_scenario_is_good_or_refused_in_one_line_that_names_its_file(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_bytes(tomlkit.dumps(without_none(content)).encode("utf-8", "replace"))
    refused = said_by(made_of, path)
    if refused is None:
        load_bench(path.with_name("made.toml"))  # what is taken can be run
        return
    assert refused.startswith(f"{path}: ")
    assert len(refused.splitlines()) == 1
    assert "made.toml" not in refused


PAGE = Path(__file__).resolve().parents[2] / "docs" / "faults.md"


def test_the_page_names_every_kind_on_the_hosts_side_and_every_shipped_scenario():
    words = set(re.findall(r"[a-z0-9_]+", PAGE.read_text()))
    assert set(HOST_KINDS) - words == set()
    assert set(shipped_scenarios()) - words == set()


def test_the_pages_example_is_good(bench):
    made = bench(re.search(r"^```toml\n(.*?)^```", PAGE.read_text(), re.S | re.M)[1])
    assert [i.kind for i in made.faults.injections] == ["serial_drop", "process_kill"]
