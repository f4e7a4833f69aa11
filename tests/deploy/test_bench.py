import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.deploy.bench import _merge, find_bench, load_bench, process_config, read_source, shipped_benches
from softloop.deploy.node import PROCESSES, find_process, processes_of
from softloop.deploy.run_dir import keep_bench, make_run_dir
from softloop.offline.evaluation import tuned
from softloop.wire.errors import EXIT_USAGE, BadConfig, BadFile, Unavailable

WHOLE = """
name = "whole"
[can.can0]
[plant]
[valves]
[pressures]
[inclinometer]
port = "{run_dir}/inclinometer"
[controller]
[recorder]
"""


def write(folder, text, name="bench.toml"):
    file = folder / name
    file.write_text(text)
    return file


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            ("[can.can0]", "speed = 1\n[can.can0]"),
            "unknown key 'speed'; allowed here: calibration, can, clock, controller, faults, foxglove, ",
        ),
        (("[recorder]", "[recorder]\nfiel = 'a'"), "unknown key 'recorder.fiel'; allowed here: backlog_messages, "),
        (("[controller]", "[controller]\nlaw = 'lqr'"), "key 'controller.law': Input should be 'pid', "),
        (
            ("[controller]", "[controller]\napproach_s = '4'"),
            "key 'controller.approach_s': Input should be a valid number (got '4')",
        ),
        (
            ("[controller]", "[controller]\npredict = 'yes'"),
            "key 'controller.predict': Input should be a valid boolean (got 'yes')",
        ),
        (("[controller]", "[controller]\napproach_s = nan"), "key 'controller.approach_s': "),
        (("[controller]", "[controller]\napproach_s = 1979-05-27"), "key 'controller.approach_s': "),
        (("[controller]\n", "[[controller]]\n"), "key 'controller': "),
        (("[can.can0]", "[can.can0]\nbitrate = 5"), "key 'can.can0.bitrate': Input should be greater than or equal to 10000"),
        (("[valves]", "[valves]\ncan = 'can7'"), "key 'valves.can': there is no [can.can7]; there are: can0"),
        (("[plant]", "[plant]\ncan_analog = 'x'"), "key 'plant.can_analog': there is no [can.x]; there are: can0"),
        (("[pressures]", "[pressures]\ncan = 'can1'"), "there is no [can.can1]; there are: can0"),
        (("[valves]", "[valves]\nangle_min_deg = 300.0"), "key 'valves': angle_min_deg must be below angle_max_deg"),
        (
            ("[can.can0]", "[can.can1.emulation]\n[can.can0]"),
            "key 'can.can1.emulation': the simulated rig holds an emulated bus, so [plant] must be on [can.can1]",
        ),
        (
            ("[can.can0]", '[pace]\nmode = "lockstep"\n[can.can0.emulation]\nbus_errors = true\n[can.can0]'),
            "key 'can.can0.emulation.bus_errors': must be false at lockstep pace",
        ),
        (
            ("[can.can0]", '[[faults.injections]]\nkind = "bus_disturb"\ntarget = "driver"\nat_s = 1.0\n[can.can0]'),
            "key 'faults.injections.0': kind 'bus_disturb' needs a [can.NAME.emulation]",
        ),
        (
            ("[can.can0]", '[[faults.injections]]\nkind = "router_loss"\nat_s = 1.0\n[can.can0]'),
            "key 'faults.injections.0': kind 'router_loss' needs [run] shared_router = true",
        ),
        (
            (
                "[can.can0]",
                '[zenoh]\nendpoint = "tls/127.0.0.1:7447"\n[zenoh.tls]\nfolder = "keys"\n[can.can0.emulation]\n[can.can0]',
            ),
            "key 'can': on a secured bench the gate alone may put valve frames on the wire",
        ),
        (('[inclinometer]\nport = "{run_dir}/inclinometer"', ""), "the gate needs the tables [pressures] and [inclinometer]"),
        (('name = "whole"', 'name = "Whole!"'), "key 'name': String should match pattern"),
        (('name = "whole"', f'name = "{"n" * 25}"'), "key 'name': String should match pattern"),
        (('name = "whole"', ""), "key 'name' is missing"),
        (("[can.can0]", "[zenoh]\nendpoint = 'tcp/0.0.0.0:7447'\n[can.can0]"), "key 'zenoh.endpoint': must begin with one of "),
        (("[can.can0]", "base = 7\n[can.can0]"), "key 'base': must be the name of a bench file in quotes (got 7)"),
        (("[can.can0]", "without = 'plant'\n[can.can0]"), "key 'without': must be a list of table names in quotes"),
        (("[can.can0]", "without = ['plamt']\n[can.can0]"), "key 'without': the base has no 'plamt'"),
        (("[can.can0]", 'without = ["pl\\nt"]\n[can.can0]'), r"key 'without': the base has no 'pl\nt'"),
        (("[can.can0]", "base = 'gone.toml'\n[can.can0]"), "key 'base': there is no file "),
        (("[can.can0]", "base = 'bench.toml'\n[can.can0]"), "key 'base': more than 8 files deep"),
    ],
)
def test_a_fault_is_said_in_one_line_with_key_file_and_what_is_allowed(tmp_path, changed, said):
    assert changed[0] in WHOLE
    file = write(tmp_path, WHOLE.replace(*changed))
    with pytest.raises((BadConfig, BadFile)) as caught:
        load_bench(file)
    text = str(caught.value)
    assert text.startswith(f"{file}: ")
    assert said in text
    assert "\n" not in text
    assert caught.value.exit_code == EXIT_USAGE


@pytest.mark.parametrize(("content", "said"), [(b"name = ", "not valid TOML"), (b"name = '\xff'", "not UTF-8 text")])
def test_a_file_that_is_no_toml(tmp_path, content, said):
    file = tmp_path / "bench.toml"
    file.write_bytes(content)
    with pytest.raises(BadFile, match=said):
        load_bench(file)


def test_a_missing_file_names_the_shipped_ones(tmp_path):
    with pytest.raises(BadFile, match=r"nowhere: there is no such bench file; shipped ones go by name: .*sim"):
        find_bench(tmp_path / "nowhere")
    assert find_bench(shipped_benches()["sim"]) == shipped_benches()["sim"]


def test_a_fault_names_the_file_it_stands_in(tmp_path):
    base = write(tmp_path, WHOLE.replace("[controller]", "[controller]\nlaw = 'lqr'"), "base.toml")
    child = write(tmp_path, "base = 'base.toml'\nname = 'child'\n[recorder]\nflush_s = 0.5\n")
    with pytest.raises(BadConfig, match=r"key 'controller\.law'") as caught:
        load_bench(child)
    assert str(caught.value).startswith(f"{base}: ")
    write(tmp_path, WHOLE, "base.toml")
    child.write_text("base = 'base.toml'\n[valves]\ncan = 'can9'\n")
    with pytest.raises(BadConfig, match="there is no ") as caught:
        load_bench(child)
    assert str(caught.value).startswith(f"{child}: ")


def test_a_child_replaces_key_by_key_and_leaves_out_tables(tmp_path):
    write(tmp_path, WHOLE.replace("[controller]", "[controller]\ntrajectory = 't2'\n[controller.arc]\nk1 = 9.0"), "base.toml")
    file = write(tmp_path, "base = 'base.toml'\nwithout = ['plant', 'controller.arc']\n[controller]\nlaw = 'pid'\n")
    bench = load_bench(file)
    assert bench.plant is None
    assert (bench.name, bench.controller.law, bench.controller.trajectory) == ("whole", "pid", "t2")
    assert bench.controller.arc == type(bench.controller.arc)()


def test_run_dir_and_bench_dir_are_filled_in_everywhere(tmp_path):
    folder = tmp_path / "benches"
    folder.mkdir()
    file = write(folder, WHOLE.replace("[controller]", "[controller]\ntrajectory = '{bench_dir}/my.csv'"))
    bench = load_bench(file, tmp_path / "run")
    assert bench.inclinometer.port == f"{tmp_path}/run/inclinometer"
    assert bench.plant.serial == f"pty://{tmp_path}/run/inclinometer"  # a default value
    assert bench.controller.trajectory == f"{folder}/my.csv"
    assert load_bench(file).inclinometer.port == "{run_dir}/inclinometer"


def test_every_process_of_a_run_has_the_same_port_and_other_runs_another(tmp_path):
    def ports(run):
        bench = load_bench(shipped_benches()["sim"], tmp_path / run)
        return {bench.plant.serial.removeprefix("listen"), bench.inclinometer.port.removeprefix("socket")}

    assert ports("a") == ports("a") != ports("b")
    assert len(ports("a")) == 1
    assert re.fullmatch(r"://127\.0\.0\.1:[23]\d{4}", ports("a").pop())


def test_what_is_kept_with_a_run_is_the_same_bench(tmp_path):
    bench = load_bench(shipped_benches()["slcan"], tmp_path)
    kept = keep_bench(tmp_path, bench)
    assert load_bench(kept, tmp_path) == bench
    assert "{run_dir}" not in kept.read_text()


def test_a_run_dir_is_not_used_twice(tmp_path):
    bench = load_bench(write(tmp_path, WHOLE))
    run_dir = make_run_dir(bench, tmp_path / "a" / "b")
    keep_bench(run_dir, bench)
    with pytest.raises(Unavailable, match="holds a run already"):
        make_run_dir(bench, run_dir)
    with pytest.raises(Unavailable, match="cannot be made"):
        make_run_dir(bench, tmp_path / "bench.toml" / "x")


@pytest.mark.parametrize("name", sorted(shipped_benches()))
def test_shipped_benches_load_and_every_process_has_its_config(name, tmp_path):
    bench = load_bench(shipped_benches()[name], tmp_path)
    assert all(process_config(bench, p.name) is not None for p in processes_of(bench))


def test_processes_are_those_whose_tables_stand_in_the_file():
    everything = {p.name for p in PROCESSES} - {"monitor", "shadow"}
    assert {p.name for p in processes_of(load_bench(shipped_benches()["sim"]))} == everything
    real = load_bench(shipped_benches()["real"])
    assert {p.name for p in processes_of(real)} == everything - {"plant"}
    with pytest.raises(BadConfig, match="bench 'real' has no process 'plant'; it has: recorder, valves, "):
        find_process(real, "plant")


def test_a_monitor_is_asked_for_by_its_table_and_keeps_no_step(tmp_path):
    text = shipped_benches()["sim"].read_text() + "\n[monitor]\nfaults_gate = true\n"
    (tmp_path / "watched.toml").write_text(text)
    bench = load_bench(tmp_path / "watched.toml")
    assert "monitor" in {p.name for p in processes_of(bench)}
    given = process_config(bench, "monitor")
    assert (given.table.faults_gate, given.parameters, given.angle) == (True, "table1", True)
    assert (given.law.k1, given.law.epsilon1) == (bench.controller.arc.k1, bench.controller.arc.epsilon1)
    lockstep = bench.model_copy(update={"pace": bench.pace.model_copy(update={"mode": "lockstep"})})
    assert "monitor" not in {p.name for p in processes_of(lockstep)}


def test_a_real_rig_differs_from_the_simulated_one_in_addresses_only():
    sim, real = (read_source(shipped_benches()[name]).content for name in ("sim", "real"))
    assert _differences(sim, real) == {
        ("name",),
        ("plant",),
        ("can", "can0", "interface"),
        ("can", "can0", "channel"),
        ("inclinometer", "port"),
    }


def _differences(one, other, where=()):
    if not (isinstance(one, dict) and isinstance(other, dict)):
        return set() if one == other else {where}
    missing = object()
    found = set()
    for key in one.keys() | other.keys():
        found |= _differences(one.get(key, missing), other.get(key, missing), (*where, key))
    return found


tables = st.recursive(
    st.integers() | st.text("ab", max_size=2) | st.lists(st.integers(), max_size=2),
    lambda inner: st.dictionaries(st.sampled_from(["a", "b", "c"]), inner, max_size=3),
    max_leaves=6,
)


@given(st.dictionaries(st.sampled_from(["a", "b", "c"]), tables), st.dictionaries(st.sampled_from(["a", "b", "c"]), tables))
def test_merging_keeps_everything_of_the_child_and_all_else_of_the_base(base, child):
    merged, origins = {}, {}
    _merge(merged, origins, base, Path("base"), ())
    _merge(merged, origins, child, Path("child"), ())
    for where, value in _leaves(child):
        assert _at(merged, where) == value
        assert origins[where] == Path("child")
    for where, value in _leaves(base):
        if not _replaced(child, where):
            assert _at(merged, where) == value


def _leaves(table, where=()):
    for key, value in table.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, (*where, key))
        elif not isinstance(value, dict):
            yield (*where, key), value


def _replaced(child, where):
    """Whether the child has something of its own at a key of the base, or in place of a table around it."""
    for key in where:
        if not isinstance(child, dict):
            return True
        if key not in child:
            return False
        child = child[key]
    return True


def _at(table, where):
    for key in where:
        table = table[key]
    return table


def test_loading_a_bench_imports_neither_numba_nor_scipy():
    program = (
        "import sys; from softloop.deploy.bench import *; import softloop.deploy.node;"
        "load_bench(shipped_benches()['sim']);"
        "print(sorted({'numba', 'scipy', 'llvmlite', 'matplotlib'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "[]"


def test_a_shadow_on_a_bus_that_is_not_there_is_refused_in_one_line(tmp_path):
    file = write(tmp_path, "name = 'x'\n[can.can1]\n[shadow]\n[valves]\n")
    with pytest.raises(BadConfig, match=r"key 'valves\.can': there is no \[can\.can0\]; there are: can1$"):
        load_bench(file)


def test_a_kept_bench_is_toml_that_others_can_read(tmp_path):
    kept = keep_bench(tmp_path, load_bench(shipped_benches()["sim"], tmp_path))
    assert tomllib.loads(kept.read_text())["controller"]["trajectory"] == "t1"


def test_the_bench_of_our_own_law_has_the_gains_that_tuning_found():
    told = load_bench(shipped_benches()["sim_eso"]).controller
    found, _ = tuned("arc_eso")
    assert told == found.model_copy(update={"trajectory": told.trajectory})
