"""`softloop calibrate` as a person types it: a WT931 on a pseudo-terminal, an analogue module on a bus in this process."""

import threading
import time

import can
import pytest
from tests.deploy.test_device_setup import bench_with, folder, softloop
from tests.deploy.wt931_on_a_pty import Wt931

from softloop.deploy.bench import load_bench
from softloop.devices.protocols import can_frames
from softloop.devices.protocols.quantise import VOLTS_PER_COUNT
from softloop.wire.errors import BadConfig, BadFile

__all__ = ["folder"]
SECONDS = ("--seconds", "1.6")  # twice what brings the samples that are needed: the machine may be busy


class Analog(threading.Thread):
    """The analogue module with two sensors of 0 to 10 V and 250 kPa, the chamber's with an error of zero and gain."""

    def __init__(self):
        super().__init__(daemon=True)
        self.supply_kpa, self.chamber_kpa, self.driver_ma, self.ending = 0.0, 0.0, None, False
        self.bus = can.Bus(interface="virtual", channel="calibrated", ignore_config=True)
        self.start()

    def run(self):
        count = 0
        while not self.ending:
            count += 1
            volts = (self.supply_kpa / 25.0, 0.2 + 1.02 * self.chamber_kpa / 25.0)
            frame = can_frames.AnalogFrame(*(round(v / VOLTS_PER_COUNT) + count % 2 for v in volts), count % 256)
            self.send(can_frames.ANALOG_INPUTS_ID, can_frames.encode_analog_inputs(frame))
            if self.driver_ma is not None:
                status = can_frames.ValveStatusFrame(count % 15, 1, round(100 * self.driver_ma), 20_000, 0)
                self.send(can_frames.VALVE_STATUS_ID, can_frames.encode_valve_status(status))
            time.sleep(0.004)
        self.bus.shutdown()

    def send(self, arbitration_id, data):
        self.bus.send(can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=False))

    def end(self):
        self.ending = True
        self.join(5.0)


@pytest.fixture
def rig(folder):
    analog, imu = Analog(), Wt931(folder / "imu", rate_hz=200, baud=115_200)
    yield analog, imu
    analog.end()
    imu.end()


def bench(folder, head=""):
    text = (
        '[can.can0]\ninterface = "virtual"\nchannel = "calibrated"\n[valves]\n[pressures]\n'
        f'[inclinometer]\nport = "{folder}/imu"\n'
    )
    file = bench_with(folder, text)
    file.write_text(head + file.read_text())
    return file


def test_zero_then_known_point_and_the_bench_takes_them(folder, rig, capsys):
    analog, imu = rig
    imu.angle_deg = -8.0
    piece = folder / "calibration.toml"
    assert softloop("calibrate", bench(folder), "--output", piece, "--rest-deg", "5", "--supply-vented", *SECONDS) == 0
    said = capsys.readouterr().out
    assert 'the bench takes it with pieces = ["calibration.toml"]' in said
    file = bench(folder, 'pieces = ["calibration.toml"]\n')
    after = load_bench(file)
    assert after.pressures.chamber.zero_v == pytest.approx(0.2, abs=0.002)
    assert after.pressures.supply.zero_v == pytest.approx(0.0, abs=0.002)
    assert after.inclinometer.zero_deg == pytest.approx(-13.0, abs=0.02)
    imu.angle_deg, analog.chamber_kpa, analog.supply_kpa = -13.0 - 90.0, 100.0, 200.0
    point = ("--chamber-kpa", "100", "--supply-kpa", "200", "--bent-deg", "90")
    assert softloop("calibrate", file, "--output", piece, *point, *SECONDS) == 0
    after = load_bench(file)
    chamber = after.pressures.chamber
    assert chamber.span_kpa / (chamber.full_v - chamber.zero_v) == pytest.approx(25.0 / 1.02, abs=0.03)
    assert (after.inclinometer.direction, after.inclinometer.zero_deg) == (-1, pytest.approx(13.0, abs=0.02))
    assert softloop("check", file) in (0, 2)  # its tables agree; it has no controller


def test_nonsense_is_refused_and_nothing_is_written(folder, rig, capsys):
    analog, _ = rig
    analog.chamber_kpa, analog.driver_ma = 80.0, 30.0
    piece = folder / "calibration.toml"
    assert softloop("calibrate", bench(folder), "--output", piece, *SECONDS) == 1
    said = capsys.readouterr().out
    assert "refused: chamber: reads 8" in said
    assert "refused: the charge coil carries 30.0 mA" in said
    assert "nothing written" in said
    assert not piece.exists()


def test_a_piece_that_the_bench_does_not_take_is_not_gone_on_with(folder, rig, capsys):
    piece = folder / "calibration.toml"
    piece.write_text("[pressures.chamber]\nzero_v = 0.3\n")
    assert softloop("calibrate", bench(folder), "--output", piece, "--chamber-kpa", "100", *SECONDS) == 2
    assert "take the piece over first" in capsys.readouterr().err


def test_rest_and_a_known_point_at_once_are_refused(folder, capsys):
    assert softloop("calibrate", bench(folder), "--output", folder / "c.toml", "--rest-deg", "0", "--bent-deg", "90") == 2
    assert "one after the other" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--rest-deg", "--chamber-kpa", "--supply-kpa", "--bent-deg"])
def test_what_is_no_number_is_refused_and_the_piece_stays(folder, option, capsys):
    piece = folder / "calibration.toml"
    piece.write_text("[inclinometer]\nzero_deg = 0.0\n")
    assert softloop("calibrate", bench(folder), "--output", piece, option, "nan") == 2
    assert f"'{option}': nan is not a finite number" in capsys.readouterr().err
    assert piece.read_text() == "[inclinometer]\nzero_deg = 0.0\n"


@pytest.mark.parametrize(
    ("head", "piece", "error", "said"),
    [
        ('pieces = ["c.toml"]\n', None, BadFile, "key 'pieces': there is no file"),
        ('pieces = "c.toml"\n', "", BadConfig, "must be a list of file names in quotes"),
        ('pieces = ["c.toml"]\n', 'base = "x.toml"\n', BadConfig, "c.toml: key 'base': a piece has none"),
        (
            'pieces = ["c.toml"]\n',
            "[pressures.chamber]\nzero_w = 1\n",
            BadConfig,
            r"c.toml: unknown key 'pressures.chamber.zero_w'",
        ),
        ('pieces = ["c.toml"]\n', "[pressures", BadFile, "c.toml"),
    ],
)
def test_what_is_wrong_with_a_piece_names_the_piece(folder, head, piece, error, said):
    if piece is not None:
        (folder / "c.toml").write_text(piece)
    with pytest.raises(error, match=said) as raised:
        load_bench(bench(folder, head))
    assert "\n" not in str(raised.value)


def test_a_bench_file_has_the_last_word_over_its_piece(folder):
    (folder / "c.toml").write_text('[inclinometer]\nzero_deg = 3.0\nport = "elsewhere"\n')
    loaded = load_bench(bench(folder, 'pieces = ["c.toml"]\n'))
    assert (loaded.inclinometer.zero_deg, loaded.inclinometer.port) == (3.0, f"{folder}/imu")
