"""The systemd units: what they grant, what they take away, what systemd itself says of them, and a kernel run as they run it."""

import configparser
import json
import os
import pwd
import shutil
import stat
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import typer

from softloop.deploy.cli import app
from softloop.deploy.install import OWN_FOLDERS, install
from softloop.deploy.node import KEPT_PROCESSES
from softloop.deploy.services import Setting, in_a_home, needed, out_of_reach, units
from softloop.wire import errors
from softloop.wire.config import HostConfig

PROGRAM = Path(sys.executable).with_name("softloop")
MOST_EXPOSED = "25"  # of 100: systemd's own account; the least that numba, real time and devices leave is below
NOBODY = 65534


def softloop(*arguments):
    command = [sys.executable, "-m", "softloop.deploy.cli", "install", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, stdin=subprocess.DEVNULL)


def read(unit):
    """Section -> key -> all values, in their order."""
    sections, now = {}, None
    for line in unit.text().splitlines():
        if line.startswith("["):
            now = sections.setdefault(line.strip("[]"), {})
        elif line and not line.startswith("#"):
            key, value = line.split("=", 1)
            now.setdefault(key, []).append(value)
    return sections


def by_name(**chosen):
    return {unit.name: read(unit) for unit in units(Setting(PROGRAM, **chosen))}


def test_the_control_path_is_never_started_again_by_itself_and_what_listens_is():
    of = by_name()
    assert of["softloop"]["Service"]["Restart"] == ["no"]
    assert "Install" not in of["softloop"]  # it cannot be enabled: a machine that boots moves nothing
    for name in ("softloop-router", "softloop-page", "softloop-foxglove"):
        assert of[name]["Service"]["Restart"] == ["always"]
        assert of[name]["Install"] == {"WantedBy": ["multi-user.target"]}
        assert "2" in of[name]["Service"]["RestartPreventExitStatus"][0].split()  # a bad file stays bad
    # What a unit starts again is no process of the control path, and none that the launcher brings back.
    started = {section["Service"]["ExecStart"][0].split()[1] for section in of.values()}
    assert started == {"run", "router", "page", "foxglove"}
    assert not started & {"controller", "valves", "pressures", "inclinometer", "plant", *KEPT_PROCESSES}


def test_the_run_gets_what_the_5_ms_path_asks_for():
    service = by_name(cpus="2-3")["softloop"]["Service"]
    assert int(service["LimitRTPRIO"][0]) >= HostConfig().realtime_priority
    assert service["LimitMEMLOCK"] == ["infinity"]
    assert service["CPUAffinity"] == ["2-3"]
    assert "CPUAffinity" not in by_name()["softloop"]["Service"]
    assert "AF_CAN" in service["RestrictAddressFamilies"][0].split()
    assert {"char-ttyUSB rw", "char-ttyACM rw"} <= set(service["DeviceAllow"])
    assert not {"MemoryDenyWriteExecute", "RestrictRealtime"} & set(service)


def test_one_of_several_hosts_runs_its_own_share():
    (started,) = by_name(host="board")["softloop"]["Service"]["ExecStart"]
    assert started.split()[1:] == ["run", "--quiet", "--host", "board", "/etc/softloop/%i.toml"]
    assert "--host" not in by_name(host="board")["softloop-router"]["Service"]["ExecStart"][0]


def test_a_stop_reaches_the_launcher_first_and_waits_for_it():
    service = by_name()["softloop"]["Service"]
    assert service["ExecStop"] == ["-/bin/kill -TERM $MAINPID", "-/usr/bin/tail --pid=${MAINPID} -f /dev/null"]
    assert "KillMode" not in service  # of a launcher that died, the rest gets SIGTERM, and the gate vents
    assert int(service["TimeoutStopSec"][0]) >= 60


@pytest.mark.parametrize("name", ["softloop", "softloop-router", "softloop-page", "softloop-foxglove"])
def test_every_unit_has_a_user_and_folders_of_its_own_and_is_shut_in(name):
    service = by_name(user="rig")[name]["Service"]
    assert (service["User"], service["Group"]) == (["rig"], ["rig"])
    for kind in ("Cache", "State", "Runtime"):
        assert (service[f"{kind}Directory"], service[f"{kind}DirectoryMode"]) == (["softloop"], ["0750"])
    assert service["RuntimeDirectoryPreserve"] == ["yes"]
    assert "XDG_CACHE_HOME=%C" in service["Environment"][0].split()
    assert service["ProtectSystem"] == ["strict"]
    assert service["NoNewPrivileges"] == ["yes"]
    assert service["CapabilityBoundingSet"] == [""]
    assert service["IPAddressDeny"] == ["any"]
    assert "IPAddressDeny" not in by_name(network=True)[name]["Service"]


def test_the_units_are_well_formed(tmp_path):
    for unit in units(Setting(PROGRAM)):
        parser = configparser.RawConfigParser(strict=False, interpolation=None)
        parser.read_string(unit.text())
        assert parser.sections()[:2] == ["Unit", "Service"]


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd-analyze here")
def test_systemd_finds_nothing_wrong_and_little_exposed(tmp_path):
    done = softloop("--to", tmp_path, "--cpus", "0", "--program", PROGRAM)
    assert done.returncode == 0, done.stderr
    files = sorted(tmp_path.glob("*.service"))
    assert len(files) == 4
    verified = subprocess.run(["systemd-analyze", "verify", *files], capture_output=True, text=True, timeout=60, check=False)
    assert (verified.returncode, verified.stdout + verified.stderr) == (0, "")
    for file in files:
        command = ["systemd-analyze", "security", "--offline=yes", f"--threshold={MOST_EXPOSED}", "--no-pager", str(file)]
        judged = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert judged.returncode == 0, judged.stdout[-200:] + judged.stderr


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="there is no systemd-analyze here")
def test_systemd_would_find_something_wrong(tmp_path):
    """The two judges are awake: a key with a wrong value is found, and one without a sandbox is too exposed."""
    (unit, *_) = units(Setting(PROGRAM))
    broken = tmp_path / "broken@.service"
    broken.write_text(unit.text().replace("LimitRTPRIO=60", "LimitRTPRIO=sixty"))
    verified = subprocess.run(["systemd-analyze", "verify", broken], capture_output=True, text=True, timeout=60, check=False)
    assert "sixty" in verified.stderr
    bare = tmp_path / "bare@.service"
    bare.write_text(f"[Unit]\nDescription=bare\n[Service]\nExecStart={PROGRAM} run %i\n")
    command = ["systemd-analyze", "security", "--offline=yes", f"--threshold={MOST_EXPOSED}", "--no-pager", str(bare)]
    assert subprocess.run(command, capture_output=True, text=True, timeout=60, check=False).returncode != 0


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("--to", "/no/such/folder"), 3, "/no/such/folder: there is no such folder"),
        (("--to", ".", "--program", "softloop"), 2, "give the whole paths"),
        (("--to", ".", "--program", "/no/softloop"), 2, "there is no such file"),
        (("--to", ".", "--program", "/bin/my softloop"), 2, "cannot stand in a unit"),
        (("--to", ".", "--user", "a\nExecStartPre=/bin/evil"), 2, "cannot stand in a unit"),
        (("--to", ".", "--user", ""), 2, "cannot stand in a unit"),
        (("--to", ".", "--benches", "/etc/$HOME"), 2, "cannot stand in a unit"),
        (("--to", ".", "--user", "root"), 2, "is root"),
        (("--to", ".", "--user", "0"), 2, "not first a digit"),
        (("--to", ".", "--user", "-x"), 2, "not first a digit"),
        (("--to", ".", "--user", "Rig"), 2, "a name is a-z"),
        (("--to", ".", "--user", "rig.one"), 2, "a name is a-z"),
        (("--to", ".", "--user", "r" * 33), 2, "at most 32 signs"),
        (("--to", ".", "--cpus", "all"), 2, "cores by number"),
        (("--to", ".", "--cpus", ", ,"), 2, "cores by number"),
        (("--to", ".", "--cpus", " "), 2, "cores by number"),
        (("--to", ".", "--cpus", "-"), 2, "cores by number"),
        (("--to", ".", "--cpus", "1,,2"), 2, "cores by number"),
        (("--to", ".", "--cpus", "1-2-3"), 2, "cores by number"),
        (("--to", ".", "--cpus", "0\n1"), 2, "cores by number"),
        (("--to", ".", "--cpus", "99-1"), 2, "99-1 goes down; write 1-99"),
        (("--to", ".", "--cpus", "0-99999"), 2, "no machine has a core 99999"),
        (("--to", ".", "--host", "a b"), 2, "a name is a-z"),
    ],
)
def test_a_mistake_is_one_line_and_writes_nothing(arguments, code, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = softloop(*arguments)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (code, "", 1)
    assert said in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("cpus", ["", "0", "0-0", "0,0", "0 0", "0 , 0", " 0"])
def test_cores_that_are_here_are_taken_as_they_are_given(cpus, tmp_path, capsys):
    assert install(tmp_path, Setting(PROGRAM, cpus=cpus)) == 0
    assert "no core" not in capsys.readouterr().out
    assert (f"CPUAffinity={cpus}\n" in (tmp_path / "softloop@.service").read_text()) == bool(cpus)


def test_cores_that_are_not_here_are_refused_for_this_machine_and_said_of_another(tmp_path, capsys, monkeypatch):
    here = os.sysconf("SC_NPROCESSORS_CONF")
    for cpus in (f"0-{here}", f"0,{here}"):
        assert install(tmp_path, Setting(PROGRAM, cpus=cpus)) == 0
        assert f"warning: --cpus {cpus}: this machine has no core {here}; it has {here}, from 0 on" in capsys.readouterr().out
        assert f"CPUAffinity={cpus}\n" in (tmp_path / "softloop@.service").read_text()
    own = tmp_path / "own"
    own.mkdir()
    (tmp_path / "link").symlink_to(own)
    monkeypatch.setattr("softloop.deploy.install.OWN_FOLDERS", (own,))
    for to in (own, tmp_path / "link"):
        with pytest.raises(errors.BadConfig, match=f"this machine has no core {here}"):
            install(to, Setting(PROGRAM, cpus=f"0-{here}"))
    assert list(own.iterdir()) == []
    assert install(own, Setting(PROGRAM, cpus=f"0-{here - 1}")) == 0


def test_where_units_go_without_a_word_is_this_machines():
    command = typer.main.get_command(app).commands["install"]
    assert next(p.default for p in command.params if p.name == "to") in OWN_FOLDERS


def test_another_name_of_root_is_root_too(tmp_path, monkeypatch):
    monkeypatch.setattr("pwd.getpwnam", lambda name: pwd.struct_passwd((name, "x", 0, 0, "", "/root", "/bin/sh")))
    with pytest.raises(errors.BadConfig, match="--user toor: is root"):
        install(tmp_path, Setting(PROGRAM, user="toor"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("user", ["rig", "_rig", "rig-2_b", "r" * 32])
def test_names_that_useradd_takes_are_good(user, tmp_path):
    assert install(tmp_path, Setting(PROGRAM, user=user)) == 0
    assert f"User={user}\n" in (tmp_path / "softloop@.service").read_text()


def test_a_second_install_replaces_the_first_and_what_is_left_is_said(tmp_path):
    assert softloop("--to", tmp_path, "--user", "one").returncode == 0
    done = softloop("--to", tmp_path, "--user", "two")
    assert "User=two" in (tmp_path / "softloop@.service").read_text()
    assert "useradd --system" in done.stdout
    assert len(list(tmp_path.iterdir())) == 4


def test_what_the_units_user_cannot_reach_is_found(tmp_path):
    program = tmp_path / "shut" / "softloop"
    program.parent.mkdir()
    interpreter = tmp_path / "python"
    interpreter.write_text("")
    program.write_text(f"#!{interpreter} -s\n")
    assert needed(program)[:2] == [program, interpreter]
    program.parent.chmod(0o700)
    program.chmod(0o755)
    assert program.parent in list(out_of_reach(program))
    program.parent.chmod(0o755)
    assert program.parent not in list(out_of_reach(program))
    assert interpreter in list(out_of_reach(interpreter))
    assert in_a_home(Path("/home/me/softloop"))
    assert not in_a_home(Path("/bin/sh"))


# --- a kernel as the units run it: as somebody without rights, from a tree that cannot be written

KERNEL = """
import json, os, sys
from softloop.devices.protocols import quantise, quantise_kernels
from softloop.wire.kernel import cache_root
function = quantise_kernels.deg_to_counts
print(json.dumps({
    "uid": os.getuid(), "value": function(12.5), "plain": quantise.deg_to_counts(12.5),
    "hits": sum(function.stats.cache_hits.values()), "file": quantise.__file__, "cache": str(cache_root()),
}))
"""


@pytest.fixture
def open_path():
    """A folder that others may enter, which one of pytest's is not: all those above it are shut to them."""
    path = Path(tempfile.mkdtemp(prefix="sl-"))
    path.chmod(0o755)
    yield path
    shutil.rmtree(path)


@pytest.fixture
def tree(open_path):
    """The package as files without links, which nobody but root may change, and a cache folder of the unprivileged user's."""
    source = Path(errors.__file__).resolve().parent.parent
    for room in ("wire", "devices"):
        shutil.copytree(source / room, open_path / "tree" / "softloop" / room, ignore=shutil.ignore_patterns("__pycache__"))
    (open_path / "tree" / "softloop" / "__init__.py").touch()
    for path in [*(open_path / "tree").rglob("*"), open_path / "tree"]:
        path.chmod(stat.S_IMODE(path.stat().st_mode) & 0o555 | 0o444 | (0o111 if path.is_dir() else 0))
    cache = open_path / "cache"
    cache.mkdir()
    if os.getuid() == 0:
        os.chown(cache, NOBODY, NOBODY)
    yield open_path
    for path in [open_path / "tree", *(open_path / "tree").rglob("*")]:
        path.chmod(0o755)


def as_nobody():
    """Words before a command that make it run without rights; where only root reaches the interpreter, it may still be read."""
    if os.getuid() != 0:
        return []
    reach = any(list(out_of_reach(path)) for path in needed(Path(sys.executable)))
    reading = ["--inh-caps=-all,+dac_read_search", "--ambient-caps=-all,+dac_read_search"] if reach else ["--inh-caps=-all"]
    return ["setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups", "--no-new-privs", *reading, "--"]


def in_tree(tree, program, cache):
    own = {"PYTHONPATH": str(tree / "tree"), "HOME": "/nonexistent", "XDG_CACHE_HOME": str(cache), "PATH": os.environ["PATH"]}
    command = [*as_nobody(), sys.executable, "-c", program]
    return subprocess.run(command, cwd="/", env=own, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.skipif(os.getuid() == 0 and shutil.which("setpriv") is None, reason="as root it needs setpriv")
def test_a_kernel_runs_as_an_unprivileged_user_from_a_read_only_tree(tree):
    before = sorted(str(path) for path in (tree / "tree").rglob("*"))
    writing = in_tree(tree, f"open({str(tree / 'tree' / 'softloop' / 'new')!r}, 'w')", tree / "cache")
    assert "PermissionError" in writing.stderr  # it is read-only indeed
    for hits in (0, 1):  # compiled, then taken from the cache
        done = in_tree(tree, KERNEL, tree / "cache")
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        assert found["uid"] == (NOBODY if os.getuid() == 0 else os.getuid())
        assert found["value"] == found["plain"] == 2276
        assert found["hits"] == hits
        assert found["file"].startswith(str(tree / "tree"))
        assert found["cache"].startswith(str(tree / "cache"))
    assert sorted(str(path) for path in (tree / "tree").rglob("*")) == before
    assert list((tree / "cache").rglob("*.nbi"))


@pytest.mark.skipif(os.getuid() == 0 and shutil.which("setpriv") is None, reason="as root it needs setpriv")
def test_without_a_cache_folder_it_is_said_in_one_line_which_one_is_missing(tree):
    program = (
        "from softloop.wire.errors import Unavailable\n"
        "try:\n    from softloop.devices.protocols import quantise_kernels\n"
        "except Unavailable as error:\n    print(error)\n"
    )
    done = in_tree(tree, program, "/nonexistent")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("/nonexistent/softloop/kernels: compiled kernels cannot be kept there")
    assert done.stdout.count("\n") == 1
