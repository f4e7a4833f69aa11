"""`softloop doctor` as a person runs it: on whole and on broken simulated rigs, and on devices that are not there."""

import json
import os
import shutil
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from tests.wire.rendezvous import short_folder

from softloop.deploy.bench import load_bench, shipped_benches
from softloop.deploy.router import launcher_wire
from softloop.deploy.run_dir import bench_lock, keep_certificate
from softloop.devices.protocols.can_frames import STATE_WATCHDOG
from softloop.wire.mcap_layout import attachments_of

pytestmark = pytest.mark.long

# A busy machine's stalls are not what these tests are about.
WIDE = "[host]\nrealtime_priority = 0\n[valves]\nage_ticks = 20\nhold_ticks = 20\n"
NEVER_OVER_S = 240
SECONDS = "1"
DEVICES = ("CAN can0", "CAN can0 load", "valve driver at rest", "pressures at rest", "inclinometer")


class Examined:
    """A bench file in a short folder of its own, and what the doctor says of it."""

    def __init__(self, folder):
        self.folder = folder
        self.file = folder / "b.toml"
        self.environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder), "TMPDIR": str(folder)}

    def write(self, text, base="sim"):
        """A shipped simulated bench, with `text` in its table [run] and after."""
        head = f'base = "{shipped_benches()[base]}"\nname = "examined"\n{WIDE}[run]\nfolder = "{self.folder}/runs"\n'
        self.file.write_text(f"{head}{text}")

    def softloop(self, *arguments, around=()):
        command = [*around, sys.executable, "-m", "softloop.deploy.cli", *arguments]
        return subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=NEVER_OVER_S,
            check=False,
            env=self.environment,
            stdin=subprocess.DEVNULL,
        )

    def doctor(self, *arguments, around=()):
        return self.softloop("doctor", str(self.file), "--seconds", SECONDS, *arguments, around=around)

    def checks(self, *arguments, **more):
        """The exit code, and name -> check."""
        done = self.doctor("--json", *arguments, **more)
        answer = json.loads(done.stdout) if done.stdout else pytest.fail(done.stderr)
        assert done.returncode == (1 if answer["verdict"] == "fail" else 0), done.stderr
        return done.returncode, {check["name"]: check for check in answer["checks"]}

    def left(self):
        """What stands in the folder beside the bench file."""
        return sorted(path.name for path in self.folder.iterdir() if path != self.file)


@contextmanager
def examined():
    with short_folder() as folder:
        yield Examined(folder)


@pytest.fixture
def place():
    with examined() as place:
        yield place


def faults(*kinds):
    """Tables of faults from the start on; "kind=size" where it has one."""
    tables = []
    for kind in kinds:
        name, _, size = kind.partition("=")
        tables.append(f'[[plant.faults]]\nkind = "{name}"\non_s = 0.001\n' + (f"size = {size}\n" if size else ""))
    return "".join(tables)


def test_a_whole_simulated_rig_has_no_device_that_fails_and_leaves_nothing(place):
    place.write("")
    certificate = place.folder / "certificate.json"
    for _ in range(5):  # a busy machine may spoil one look, and says so; not all
        _, found = place.checks("--certificate", str(certificate))
        if not any(found[name]["verdict"] == "fail" for name in DEVICES):
            break
    for name in DEVICES:
        assert found[name]["verdict"] != "fail", found[name]
        assert found[name]["found"].startswith("simulated by [plant]: ")
    assert found["bench"]["verdict"] == "pass"
    assert found["bench"]["measured"]["trajectory_s"] > 10
    assert found["valve driver at rest"]["found"].startswith("simulated by [plant]: its watchdog vents")
    assert found["pressures at rest"]["verdict"] == "pass"
    assert len(found["tick lateness"]["measured"]["histogram_us"]) == 9
    assert found["Zenoh round trip"]["measured"]["round_trips"] + found["Zenoh round trip"]["measured"]["lost"] == 200
    assert {"real-time priority", "clock", "disk stalls", "disk space", "versions"} <= set(found)
    assert [name for name in place.left() if name not in ("certificate.json", "softloop-examined.lock")] == []
    _goes_into_the_log(place, certificate)


def test_serial_can_adapters_are_heard_each_on_its_own_bus(place):
    """Over pseudo-terminals, whose bytes a busy machine holds up: who speaks, not how well."""
    place.write("", base="slcan")
    _, found = place.checks()
    assert found["CAN valve_bus"]["measured"]["rates_hz"]["valve driver"] > 0
    assert found["CAN analog_bus"]["measured"]["rates_hz"]["analogue module"] > 0
    assert found["valve driver at rest"]["measured"]["state"] == STATE_WATCHDOG
    assert found["pressures at rest"]["verdict"] == "pass"


def _goes_into_the_log(place, certificate):
    place.write(f'certificate = "{certificate}"\n')
    run_dir = place.folder / "run"
    run_dir.mkdir()
    keep_certificate(run_dir, load_bench(place.file, run_dir))
    kept = json.loads(attachments_of(run_dir)["certificate.json"])
    assert kept["bench"] == "examined"
    assert {check["name"] for check in kept["checks"]} >= set(DEVICES)


@pytest.mark.parametrize(
    ("broken", "name", "verdict", "said"),
    [
        (("inclinometer_silent", "driver_silent", "chamber_bias=400.0"), "inclinometer", "fail", "no bytes"),
        (("inclinometer_silent", "driver_silent", "chamber_bias=400.0"), "CAN can0", "fail", "valve driver (id 0x90) 0 Hz"),
        (("inclinometer_silent", "driver_silent", "chamber_bias=400.0"), "pressures at rest", "warn", "is not vented"),
        (("analog_silent", "angle_bias=300.0"), "CAN can0", "fail", "analogue module (id 0x100) 0 Hz"),
        (("chamber_stuck", "angle_bias=-90.0"), "pressures at rest", "warn", "does not move at all"),
        (("chamber_stuck", "angle_bias=-90.0"), "inclinometer", "fail", "deg"),
        (("power_loss", "analog_silent"), "CAN can0", "fail", "nobody speaks"),
    ],
    scope="module",
)
def test_a_broken_device_is_found_and_what_to_do_is_said(seen, broken, name, verdict, said):
    check = seen(broken)[name]
    assert (check["verdict"], bool(check["do"])) == (verdict, True), check
    assert said in check["found"]


@pytest.fixture(scope="module")
def seen():
    """What the doctor says of a simulated rig with some faults; each asked once."""
    known = {}

    def look(broken):
        if broken not in known:
            with examined() as place:
                place.write(faults(*broken))
                _, known[broken] = place.checks()
        return known[broken]

    return look


def test_devices_that_are_not_there(place):
    place.file.write_text(
        'name = "examined"\n[host]\nrealtime_priority = 0\n[can.can0]\ninterface = "socketcan"\nchannel = "none7"\n'
        '[valves]\n[pressures]\n[inclinometer]\nport = "/dev/tty-none"\nopen_wait_s = 0.0\n'
    )
    code, found = place.checks()
    assert code == 1
    assert found["CAN can0"]["found"].startswith("not there: CAN bus socketcan:none7: ")
    assert "ip link set none7 up type can bitrate 500000" in found["CAN can0"]["do"]
    assert found["inclinometer"]["found"].startswith("not there: ")
    assert found["disk"]["found"] == "no recorder on this bench"


def test_bytes_that_are_no_samples(place):
    """A listener at the wrong baud rate sees bytes and no packets: here, a device that says nonsense."""
    device_end, host_end = os.openpty()
    try:
        place.file.write_text(
            f'name = "examined"\n[host]\nrealtime_priority = 0\n[inclinometer]\nport = "{os.ttyname(host_end)}"\n'
        )
        with subprocess.Popen([sys.executable, "-c", NONSENSE], stdout=device_end) as speaker:
            _, found = place.checks()
            speaker.kill()
        assert found["inclinometer"]["verdict"] == "fail"
        assert "no samples" in found["inclinometer"]["found"]
    finally:
        os.close(device_end)
        os.close(host_end)


NONSENSE = "import sys, time\nwhile True: sys.stdout.buffer.write(bytes(range(1, 50))); sys.stdout.flush(); time.sleep(0.01)"


def test_a_trajectory_that_cannot_be_followed_is_a_failed_check(place):
    times = "".join(f"{0.05 * k},{k * 40.0}\n" for k in range(20))
    (place.folder / "up.csv").write_text(f"t_s,value\n{times}")
    place.write('[controller]\ntrajectory = "{bench_dir}/up.csv"\n')
    code, found = place.checks()
    assert (code, found["bench"]["verdict"]) == (1, "fail")
    assert found["CAN can0"]["verdict"] != "fail"  # the devices are looked at all the same


def test_a_bench_that_runs_is_not_examined(place):
    place.write("")
    folder = os.environ.get("XDG_RUNTIME_DIR")
    os.environ["XDG_RUNTIME_DIR"] = str(place.folder)
    try:
        with bench_lock("examined"):
            done = place.doctor()
            assert (done.returncode, done.stdout, done.stderr.count("\n")) == (3, "", 1)
        with launcher_wire(load_bench(place.file)):
            done = place.doctor()
            assert (done.returncode, done.stdout) == (3, "")
            assert "in use" in done.stderr
    finally:
        if folder is None:
            del os.environ["XDG_RUNTIME_DIR"]
        else:
            os.environ["XDG_RUNTIME_DIR"] = folder


def test_mistakes_are_one_line(place):
    place.write("[recorder]\nfile = 3\n")
    done = place.doctor()
    assert (done.returncode, done.stderr.count("\n"), done.stdout) == (2, 1, "")
    place.write('certificate = "/no/such/file"\n')
    done = place.softloop("run", str(place.file), "--run-dir", str(place.folder / "r"))
    assert (done.returncode, done.stderr) == (2, "softloop: /no/such/file: cannot be read: No such file or directory\n")


def test_a_full_disk(place):
    """A file system of its own, with no room for an hour of log: as root, in a mount namespace that ends with the doctor."""
    if os.getuid() != 0 or shutil.which("unshare") is None:
        pytest.skip("needs root and unshare, to make a small file system")
    place.write("")
    runs = Path(place.folder / "runs")
    runs.mkdir()
    for size, name, verdict in (("12m", "disk space", "fail"), ("4m", "disk stalls", "fail")):
        around = ("unshare", "-m", "sh", "-c", f'mount -t tmpfs -o size={size} none "{runs}" || exit 77; exec "$@"', "sh")
        done = place.doctor("--json", around=around)
        if done.returncode == 77:
            pytest.skip("no permission to mount here")
        found = {check["name"]: check for check in json.loads(done.stdout)["checks"]}
        assert found[name]["verdict"] == verdict, found[name]
        assert found[name]["do"]
        assert str(runs) in found[name]["found"]
