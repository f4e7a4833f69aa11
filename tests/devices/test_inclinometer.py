"""The process `inclinometer` on a real Zenoh bench, with a WT931 of ours at the other end of a pseudo-terminal."""

import threading

import pytest

from softloop.devices import inclinometer
from softloop.devices.config import InclinometerConfig
from softloop.devices.inclinometer import RateWatch
from softloop.devices.inclinometer_setup import SerialSource, configure
from softloop.devices.protocols import wt931
from softloop.devices.protocols.quantise import deg_to_counts, value_to_int16
from softloop.wire.channels import INCLINATION
from softloop.wire.clock import WallClock
from softloop.wire.errors import Lost, Unavailable
from softloop.wire.messages import constant
from softloop.wire.serial_urls import open_serial
from tests.devices.adapters import bench, listeners, run_to_its_end, running, until
from tests.wire.rendezvous import short_folder

CLOCK = WallClock()
PERIOD_NS = 5_000_000
WIRE_NS = 1_909_722
KIND_BUS = constant("Event", "KIND_BUS")


class Device(threading.Thread):
    """A WT931: packets at its rate, registers that can be written when unlocked and read."""

    def __init__(self, url, rate_hz=200, stuck=()):
        super().__init__(daemon=True)
        self.port = open_serial(url, 115_200, 0.0)
        self.period_ns, self.stuck = 1_000_000_000 // rate_hz, stuck
        self.angle_deg, self.rate_deg_s = 30.0, 5.0
        self.registers, self.saved, self.unlocked = {}, None, False
        self.sending, self.ending = True, False
        self.commands = wt931.CommandParser()
        self.start()

    def run(self):
        next_ns = CLOCK.now_ns()
        while not self.ending:
            self.answer()
            if self.sending:
                self.port.write(self.burst())
            next_ns = max(next_ns + self.period_ns, CLOCK.now_ns() - 10 * self.period_ns)
            CLOCK.sleep_until_ns(next_ns)
        self.port.close()

    def burst(self):
        gyro = wt931.encode_packet(wt931.GYRO, (value_to_int16(self.rate_deg_s, 2000.0), 0, 0, 0))
        return gyro + wt931.encode_packet(wt931.ANGLE, (deg_to_counts(self.angle_deg), 0, 0, 77))

    def answer(self):
        for register, value in self.commands.feed(self.port.read(256)):
            if register == wt931.READ:
                words = tuple(self.registers.get(value + i, 0) for i in range(4))
                self.port.write(wt931.encode_packet(wt931.REGISTERS, words))
            elif register == wt931.KEY:
                self.unlocked = value == wt931.UNLOCK_VALUE
            elif register == wt931.SAVE:
                self.saved = dict(self.registers)
            elif self.unlocked and register not in self.stuck:
                self.registers[register] = value

    def end(self):
        self.ending = True
        self.join(5.0)


class Setting:
    """A device and an adapter on a bench; `config` says what the bench file would."""

    def __init__(self, wires, folder, **config):
        self.wires, self.folder, self.path = wires, folder, folder / "imu"
        self.config = InclinometerConfig(port=str(self.path), open_wait_s=10.0, **config)
        self.samples, self.events, self.status = listeners(wires[1], INCLINATION)

    def device(self, **how):
        return Device(f"pty://{self.path}", **how)

    def running(self):
        return running(inclinometer.run, self.config, self.wires[0], self.folder)

    def run_to_its_end(self):
        run_to_its_end(inclinometer.run, self.config, self.wires[0], self.folder)


@pytest.fixture
def setting(meet):
    with short_folder() as folder, bench(meet) as wires:
        yield lambda **config: Setting(wires, folder, **config)


def test_bytes_become_samples_with_their_times(setting):
    setting = setting()
    device = setting.device()
    with setting.running():
        until(lambda: len(setting.samples.look()) > 20)
        device.angle_deg, device.rate_deg_s = 31.0, -5.0
        until(lambda: abs(setting.samples.look()[-1].rate_deg_s + 5.0) < 0.1)
    device.end()
    newest = setting.samples.look()[-1]
    assert newest.angle_deg == pytest.approx(31.0, abs=0.006)
    assert newest.status == constant("InclinationSample", "STATUS_OK")
    assert newest.received_ns - newest.stamp_ns >= WIRE_NS
    assert newest.received_ns <= newest.published_ns
    seqs = [s.seq for s in setting.samples.look()]
    assert seqs == list(range(seqs[0], seqs[0] + len(seqs)))


def test_mounting_is_taken_into_account(setting):
    setting = setting(direction=-1, zero_deg=-40.0)
    device = setting.device()
    with setting.running():
        sample = until(lambda: (setting.samples.look() or [None])[-1])
    device.end()
    assert sample.angle_deg == pytest.approx(10.0, abs=0.006)
    assert sample.rate_deg_s == pytest.approx(-5.0, abs=0.1)


def test_it_waits_for_a_port_that_comes_later(setting):
    setting = setting()
    with setting.running() as adapter:
        adapter.context.stop.wait(0.3)
        device = setting.device()
        until(setting.samples.look)
    device.end()


def test_a_lost_port_is_an_event_and_is_opened_again(setting):
    setting = setting()
    device = setting.device()
    with setting.running():
        until(setting.samples.look)
        device.end()
        until(lambda: setting.events.find(kind=KIND_BUS, code=1))
        device = setting.device()
        until(lambda: setting.events.find(kind=KIND_BUS, code=0))
        count = len(setting.samples.look())
        until(lambda: len(setting.samples.look()) > count + 5)
        device.end()
        until(lambda: sum(e.code for e in setting.events.look() if e.kind == KIND_BUS) == 2)  # ends while the port is away


def test_a_port_that_never_comes_is_one_line(setting, tmp_path):
    setting = setting()
    setting.config = setting.config.model_copy(update={"open_wait_s": 0.2})
    with pytest.raises(Unavailable, match=r"^serial port .*/imu: there is no such device$"):
        setting.run_to_its_end()


def test_a_device_with_another_rate_is_one_line(setting):
    setting = setting()
    device = setting.device(rate_hz=50)
    with pytest.raises(Unavailable, match=r"^WT931 on [^\n]*: \d+ samples per second, the bench file says 200; set configure"):
        setting.run_to_its_end()
    device.end()


def test_configuring_writes_reads_back_and_saves(setting):
    setting = setting(configure=True, rate_hz=200, bandwidth_hz=94)
    device = setting.device()
    with setting.running():
        until(setting.samples.look)
    device.end()
    assert device.saved == {wt931.RSW: 12, wt931.RRATE: 0x0B, wt931.BANDWIDTH: 2, wt931.AXIS6: 1, wt931.BAUD: 6}


def test_a_new_baud_rate_is_written_last_and_read_back(setting):
    setting = setting(configure=True, configure_baud=9600)
    device = setting.device()
    configure(setting.config, CLOCK)
    device.end()
    assert device.saved[wt931.BAUD] == 6
    assert list(device.saved)[-1] == wt931.BAUD


def test_a_register_that_does_not_take_its_value_is_one_line(setting):
    setting = setting(configure=True)
    device = setting.device(stuck=(wt931.BANDWIDTH,))
    device.registers[wt931.BANDWIDTH] = 4
    with pytest.raises(Unavailable, match="its register BANDWIDTH holds 4 after 0 was written"):
        configure(setting.config, CLOCK)
    device.end()


def test_a_device_that_does_not_answer_is_one_line(setting, monkeypatch):
    setting = setting(configure=True)
    device = setting.device()
    monkeypatch.setattr(device, "answer", lambda: None)
    with pytest.raises(Unavailable, match="no answer at 115200 baud"):
        configure(setting.config, CLOCK)
    device.end()


def test_a_socket_is_read_in_the_pieces_in_which_bytes_come():
    server = open_serial("listen://127.0.0.1:0", 115_200, 0.0)
    source = SerialSource(server.client_url, 115_200)
    until(lambda: server.connected)
    assert source.read(0.0) == b""
    server.write(b"abc" * 10)
    assert until(lambda: source.read(0.1)) == b"abc" * 10
    source.write(b"xyz")
    assert until(lambda: server.read(3)) == b"xyz"
    server.close()
    with pytest.raises(Lost, match="is lost"):
        until(lambda: source.read(0.1) is None)
    source.close()


def test_a_port_without_a_descriptor_is_read_too():
    source = SerialSource("loop://", 115_200)
    source.write(b"abc")
    assert source.read(0.1) == b"abc"
    assert source.read(0.01) == b""
    source.close()


def watched(rates, config=None):
    """What a RateWatch says of seconds with so many samples; None for a second without bytes."""
    watch = RateWatch(config or InclinometerConfig(port="x"))
    parser, now_ns, words = wt931.Parser(), 10**9, []
    parser.taken = 1
    watch.look(now_ns, parser)
    for rate in rates:
        now_ns += 10**9
        parser.accepted += 2 * (rate or 0)
        parser.taken += 22 * rate + 1 if rate is not None else 0
        words.append(watch.look(now_ns, parser))
    return words


def test_the_measured_rate_is_judged_over_some_seconds():
    assert watched([200, 198, 150, 150, 200]) == [""] * 5
    words = watched([200, 150, 150, 150, 150, 200])
    assert words[:3] == ["", "", ""]
    assert "150 samples per second" in words[3]
    assert words[4:] == ["", "200 samples per second again"]


def test_a_rate_that_never_was_right_ends_the_process():
    with pytest.raises(Unavailable, match="100 samples per second, the bench file says 200"):
        watched([100, 100, 100])
    with pytest.raises(Unavailable, match="bytes come, but no packets; is its baud rate 115200"):
        watched([0, 0, 0])


def test_silence_is_said_once():
    words = watched([200, None, None, None])
    assert "no bytes come any more" in words[1]
    assert words[2:] == ["", ""]
