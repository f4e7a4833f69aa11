import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from softloop.deploy import cli
from softloop.deploy.gate_requests import Requests, ask
from softloop.deploy.launcher import Options
from softloop.deploy.prepare import kernel_modules
from softloop.offline.tuning_ranges import RANGES
from softloop.wire.errors import EXIT_ENVIRONMENT, EXIT_INTERRUPTED, EXIT_NEGATIVE, EXIT_OK, EXIT_USAGE

TOY = str(Path(__file__).with_name("toy_node.py"))


def softloop(*arguments, timeout=60):
    """Run the command line as a person does."""
    command = [sys.executable, "-m", "softloop.deploy.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False, stdin=subprocess.DEVNULL)


@pytest.fixture
def short_dir():
    path = Path(tempfile.mkdtemp(prefix="sl-"))
    yield path
    shutil.rmtree(path)


@pytest.fixture
def bench(short_dir):
    """A bench with a gate and what it needs, and its own meeting point."""
    file = short_dir / "b.toml"
    file.write_text(f"""
name = "cli-{os.getpid()}"
[zenoh]
endpoint = "unixsock-stream/{short_dir}/m.sock"
[host]
realtime_priority = 0
[can.can0]
[valves]
[pressures]
[inclinometer]
port = "/dev/null"
""")
    return file


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("frob",), EXIT_USAGE, "No such command 'frob'"),
        (("run",), EXIT_USAGE, "Missing argument 'BENCH.toml'"),
        (("run", "sim", "--duration", "long"), EXIT_USAGE, "--duration"),
        (("run", "nowhere.toml"), EXIT_USAGE, "nowhere.toml: there is no such bench file"),
        (("check", "nowhere.toml"), EXIT_USAGE, "nowhere.toml: there is no such bench file"),
        (("node", "driver", "sim", "--run-dir", "/tmp"), EXIT_USAGE, "bench 'sim' has no process 'driver'; it has: recorder, "),
        (("run", "sim", "--host", "desk"), EXIT_USAGE, "bench 'sim' has no host 'desk'; it has: none, it runs on one"),
        (("router", "sim", "--with", "zenohd2"), EXIT_USAGE, "'zenohd2'"),
        (("request", "sim", "fly"), EXIT_USAGE, "'fly'"),
        (("report", "/no/such/run"), EXIT_USAGE, "/no/such/run"),
        (("tune", "pid", "--out", "/no/such/x.toml"), EXIT_USAGE, "--out /no/such/x.toml: there is no folder /no/such"),
        (("tune", "pid", "--out", "/tmp"), EXIT_USAGE, "--out /tmp: is a folder"),
    ],
)
def test_a_mistake_is_one_line_on_standard_error(arguments, code, said):
    done = softloop(*arguments)
    assert done.returncode == code
    assert done.stderr.startswith("softloop: ")
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""


def test_help_tells_the_exit_codes_and_loads_nothing_heavy():
    done = softloop("--help")
    assert done.returncode == EXIT_OK
    assert "Exit codes: 0 all is well; 1 the command ran" in " ".join(done.stdout.split())
    assert softloop().stdout == done.stdout
    program = "import sys, softloop.deploy.cli; print([m for m in ('zenoh', 'numpy', 'pydantic', 'rich') if m in sys.modules])"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert loaded.stdout.strip() == "[]"


def test_the_help_of_tune_names_every_law_that_can_be_tuned():
    said = " ".join(softloop("tune", "--help").stdout.split())
    assert f"One of {', '.join(RANGES)}." in said


def test_a_fault_of_ours_is_one_line_too(monkeypatch, capsys):
    monkeypatch.setattr(cli, "app", lambda *_, **__: 1 / 0)
    with pytest.raises(SystemExit) as caught:
        cli.main(["warm"])
    assert caught.value.code == 4
    assert capsys.readouterr().err == "softloop: stopped by a fault of its own: ZeroDivisionError('division by zero')\n"


def test_check_finds_a_trajectory_that_the_actuator_cannot_follow(tmp_path):
    reference = tmp_path / "up.csv"
    reference.write_text("t_s,value\n" + "".join(f"{0.05 * k},{k * 40.0}\n" for k in range(20)))
    file = tmp_path / "b.toml"
    file.write_text('name = "b"\n[controller]\ntrajectory = "{bench_dir}/up.csv"\n')
    done = softloop("check", file)
    assert done.returncode == EXIT_USAGE
    assert done.stderr.count("\n") == 1


def test_a_request_without_a_rig_says_so(bench):
    done = softloop("request", bench, "arm", "--timeout", "0.5")
    assert done.returncode == EXIT_ENVIRONMENT
    assert "no gate of bench" in done.stderr
    assert [p.name for p in bench.parent.iterdir() if p != bench] == []


def test_a_router_holds_its_address_until_it_is_stopped(bench):
    command = [sys.executable, "-m", "softloop.deploy.cli", "router", str(bench)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as router:
        assert "meeting point of bench" in router.stdout.readline()
        second = softloop("router", bench)
        router.send_signal(signal.SIGINT)
        assert router.wait(timeout=20) == EXIT_OK
    assert second.returncode == EXIT_ENVIRONMENT
    assert "the address is in use" in second.stderr


def test_run_refuses_an_address_in_use(short_dir):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        file = short_dir / "b.toml"
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        file.write_text(f'name = "taken-{os.getpid()}"\n[zenoh]\nendpoint = "{endpoint}"\n[recorder]\n')
        done = softloop("run", file, "--run-dir", short_dir / "run", timeout=300)
    assert done.returncode == EXIT_ENVIRONMENT
    assert done.stderr == f"softloop: Zenoh endpoint {endpoint}: the address is in use; is this bench running already?\n"


def test_requests_are_answered_by_the_gate(bench):
    """The real command line against a stand-in gate: armed, stopped, armed again by a word, disarmed; a broken gate refuses."""
    run_dir = bench.parent
    (run_dir / "toy.json").write_text(json.dumps({}))
    with subprocess.Popen([sys.executable, "-m", "softloop.deploy.cli", "router", str(bench)], stdout=subprocess.PIPE) as router:
        router.stdout.readline()
        read_end, write_end = os.pipe()
        command = [sys.executable, TOY, "node", "valves", str(bench), "--run-dir", str(run_dir), "--lifeline-fd", str(read_end)]
        with subprocess.Popen(command, pass_fds=(read_end,)) as gate:
            answers = [softloop("request", bench, action) for action in ("arm", "stop", "arm", "disarm")]
            gate.terminate()
        (run_dir / "toy.json").write_text(json.dumps({"valves": "faults"}))
        with subprocess.Popen(command, pass_fds=(read_end,)) as gate:
            refused = softloop("request", bench, "arm")
            gate.terminate()
        router.terminate()
        os.close(read_end)
        os.close(write_end)
    assert [a.stdout.strip() for a in answers] == ["gate armed", "gate fault", "gate armed", "gate disarmed"]
    assert [a.returncode for a in answers] == [EXIT_OK] * 4
    assert (refused.returncode, refused.stdout.strip()) == (EXIT_NEGATIVE, "refused: gate fault (sensor stale)")


class FakeState:
    """A gate that stays as it is, heard all the time."""

    def __init__(self, gate):
        self.gate, self.valves_heard_ns, self.gate_stamp_ns = gate, 1 << 62, 123

    def refresh(self):
        return []


class FakeWire:
    def __init__(self):
        self.sent = []

    def publisher(self, _channel):
        return self.sent.append

    def may_put(self, _channel):
        return True


@pytest.mark.parametrize(("gate", "sends"), [(2, 1), (0, 3)])
def test_a_gate_in_fault_is_asked_to_arm_once_only(gate, sends):
    wire = FakeWire()
    assert not ask(Requests(wire), FakeState(gate), "arm", 0.55)
    assert len(wire.sent) == sends


def test_what_is_asked_of_a_run_reaches_the_launcher(monkeypatch):
    taken = []
    monkeypatch.setattr("softloop.deploy.launcher.launch", lambda bench, options: taken.append(options) or 0)
    words = ["run", "sim", "--duration", "3", "--pace", "lockstep", "--run-dir", "there", "--no-report", "--quiet", "--page"]
    with pytest.raises(SystemExit):
        cli.main([*words, "--foxglove"])
    asked = {"duration_s": 3.0, "pace": "lockstep", "run_dir": Path("there"), "report": False, "quiet": True}
    assert taken == [Options(**asked, page=True, foxglove=True)]


def test_every_kernel_module_is_warmed():
    found = kernel_modules()
    assert "softloop.controller.tick" in found
    assert "softloop.plant.physics" in found
    assert len(found) == len(set(found))


def test_interrupted_before_anything_started(short_dir):
    file = short_dir / "b.toml"
    file.write_text(f'name = "int-{os.getpid()}"\n[zenoh]\nendpoint = "unixsock-stream/{short_dir}/m.sock"\n[recorder]\n')
    command = [sys.executable, "-m", "softloop.deploy.cli", "run", str(file), "--run-dir", str(short_dir / "run")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        while not (short_dir / "run" / "prepare.log").exists():
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=30)
    assert process.returncode == EXIT_INTERRUPTED
    assert said == "softloop: interrupted before any process was started\n"
