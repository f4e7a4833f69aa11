"""`softloop wt931 configure` and `softloop canopen configure` as a person types them, on devices in this process."""

import can
import pytest
from tests.deploy.wt931_on_a_pty import Wt931
from tests.devices.canopen_module import Module
from tests.wire.rendezvous import short_folder

from softloop.deploy.cli import main
from softloop.devices.protocols import wt931


@pytest.fixture
def folder(monkeypatch):
    with short_folder() as folder:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
        yield folder


def softloop(*arguments):
    """The exit code."""
    with pytest.raises(SystemExit) as ended:
        main([str(a) for a in arguments])
    return ended.value.code


def bench_with(folder, text):
    file = folder / "b.toml"
    file.write_text(f'name = "set-up"\n[host]\nrealtime_priority = 0\n{text}')
    return file


@pytest.fixture
def device(folder):
    device = Wt931(folder / "imu")
    yield device
    device.end()


def test_a_wt931_from_its_box_is_set_and_kept(folder, device, capsys):
    file = bench_with(folder, f'[inclinometer]\nport = "{folder}/imu"\nbandwidth_hz = 184\nrate_tolerance = 0.6\n')
    assert softloop("wt931", "configure", file, "--from-baud", "9600") == 0
    said = capsys.readouterr().out
    assert "at 115200 baud: RSW 12, RRATE 11, BANDWIDTH 1, AXIS6 1, BAUD 6" in said
    assert "samples per second, asked for were 200" in said
    kept = device.device.active
    assert (kept[wt931.RRATE], kept[wt931.BAUD], kept[wt931.BANDWIDTH]) == (0x0B, 6, 1)


def test_a_device_that_takes_its_settings_and_sends_otherwise_is_said(folder, device, capsys, monkeypatch):
    monkeypatch.setattr(type(device.device), "period_ns", property(lambda self: 20_000_000))
    file = bench_with(folder, f'[inclinometer]\nport = "{folder}/imu"\n')
    assert softloop("wt931", "configure", file) == 1
    assert "re-power it" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "more", "code", "said"),
    [
        ('[inclinometer]\nport = "{folder}/imu"\n', ("--from-baud", "1200"), 2, "--from-baud must be one of 4800, 9600"),
        ("", (), 2, "has no table [inclinometer]"),
        ('[inclinometer]\nport = "{folder}/none"\n', (), 3, "/none"),
    ],
)
def test_what_is_wrong_is_one_line(folder, device, capsys, text, more, code, said):
    file = bench_with(folder, text.replace("{folder}", str(folder)))
    assert softloop("wt931", "configure", file, *more) == code
    error = capsys.readouterr().err
    assert error.startswith("softloop: ")
    assert said in error
    assert error.count("\n") == 1


def test_a_silent_wt931_is_one_line(folder, device, capsys):
    device.deaf = True
    file = bench_with(folder, f'[inclinometer]\nport = "{folder}/imu"\n')
    assert softloop("wt931", "configure", file) == 3
    assert "no answer at 115200 baud" in capsys.readouterr().err


CANOPEN = (
    '[can.can0]\ninterface = "virtual"\nchannel = "set-up"\n[valves]\ndriver = "canopen_analog"\n'
    '[valves.canopen_analog]\nnode_id = 7\n[pressures]\n[inclinometer]\nport = "x"\n'
)


@pytest.fixture
def module():
    with can.Bus(interface="virtual", channel="set-up", ignore_config=True) as bus:
        module = Module(bus, 7)
        yield module
        module.close()


def test_a_canopen_node_from_its_box_is_made_safe_once(folder, module, capsys):
    file = bench_with(folder, CANOPEN)
    assert softloop("canopen", "configure", file) == 0
    first = capsys.readouterr().out
    assert "CANopen node 7: 12 of 13 settings were other than they must be" in first
    assert "read back" in first
    assert module.stored == 1
    assert module.held(0x6444, 2) >> 16 == int(200 / 220 * 32767)
    assert softloop("canopen", "configure", file) == 0
    assert "0 of 13 settings were other" in capsys.readouterr().out


def test_a_bench_without_a_node_is_one_line(folder, capsys):
    assert softloop("canopen", "configure", bench_with(folder, CANOPEN.replace("canopen_analog", "rig", 1))) == 2
    assert "key 'valves.driver': is no CANopen node" in capsys.readouterr().err
