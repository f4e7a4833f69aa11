import pytest

from softloop.devices.protocols.wire_time import serial_ns
from softloop.devices.protocols.wt931 import (
    ANGLE,
    BANDWIDTH,
    BAUD,
    GYRO,
    READ,
    REGISTERS,
    RRATE,
    RSW,
    SAVE,
    Parser,
    encode_command,
    encode_unlock,
    settings,
)
from softloop.plant.inclinometer_device import UNLOCKED_NS, InclinometerDevice
from softloop.plant.setup import configure_inclinometer
from tests.plant.rigs import MS, Rig, of_kind

SAVE_NOW = encode_command(SAVE, 0)


def device():
    return InclinometerDevice(200, 115_200, 256)


def test_it_starts_as_the_rig_wants_it():
    d = device()
    assert (d.period_ns, d.content, d.baud) == (5_000_000, 3, 115_200)
    assert d.wire_ns == serial_ns(22, 115_200)


def test_a_write_needs_the_unlock_and_takes_effect_with_the_save():
    d = device()
    d.feed(encode_command(RRATE, 0x09) + SAVE_NOW, 0)
    assert d.period_ns == 5_000_000
    d.feed(encode_unlock() + encode_command(RRATE, 0x09), 0)
    assert d.period_ns == 5_000_000
    d.feed(SAVE_NOW, MS)
    assert d.period_ns == 10_000_000


def test_the_unlock_ends_after_ten_seconds():
    d = device()
    d.feed(encode_unlock(), 0)
    d.feed(encode_command(RRATE, 0x09) + SAVE_NOW, UNLOCKED_NS + 1)
    assert d.period_ns == 5_000_000


def test_commands_may_come_in_pieces():
    d = device()
    for byte in encode_unlock() + encode_command(BANDWIDTH, 3) + SAVE_NOW:
        d.feed(bytes((byte,)), 0)
    assert d.lag_s == pytest.approx(1.0 / (2.0 * 3.141592653589793 * 44.0))


def test_registers_can_be_read_back():
    d = device()
    d.feed(encode_unlock() + encode_command(BAUD, 9), 0)
    (packet,) = Parser().feed(d.feed(encode_command(READ, RSW), 0))
    assert packet.kind == REGISTERS
    assert packet.words == (0x0C, 0x0B, 9, 0)


def test_every_setting_the_adapter_may_ask_for_is_taken():
    d = device()
    wanted = settings(100, 94) | {BAUD: 9}
    d.feed(encode_unlock() + b"".join(encode_command(r, v) for r, v in wanted.items()) + SAVE_NOW, 0)
    assert (d.period_ns, d.baud, d.content) == (10_000_000, 921_600, 3)
    assert d.lag_s == pytest.approx(1.0 / (2.0 * 3.141592653589793 * 94.0))


def test_a_slow_line_lowers_the_rate():
    d = InclinometerDevice(200, 9_600, 256)
    assert d.period_ns == d.wire_ns == serial_ns(22, 9_600)


def test_packets_are_what_the_parser_reads():
    d = device()
    gyro, angle = Parser().feed(d.packets(3, -5, 8192))
    assert (gyro.kind, gyro.words[0]) == (GYRO, -5)
    assert (angle.kind, angle.words[0]) == (ANGLE, 8192)
    assert [p.kind for p in Parser().feed(d.packets(2, 1, 2))] == [ANGLE]


def test_new_settings_reach_the_running_rig():
    rig = Rig(seed=1)
    rig.until(50 * MS)
    rig.device.feed(encode_unlock() + encode_command(RRATE, 0x09) + SAVE_NOW, 50 * MS)
    configure_inclinometer(rig.params, rig.state, rig.device)
    sent = of_kind(rig.until(1_050 * MS), 3)
    assert len(sent) in (99, 100, 101)
    rig.device.feed(encode_unlock() + encode_command(RSW, 0) + SAVE_NOW, 1_050 * MS)
    configure_inclinometer(rig.params, rig.state, rig.device)
    assert len(of_kind(rig.until(2_000 * MS), 3)) == 0
    rig.device.feed(encode_unlock() + encode_command(RSW, 8) + SAVE_NOW, 2_000 * MS)
    configure_inclinometer(rig.params, rig.state, rig.device)
    again = of_kind(rig.until(3_000 * MS), 3)
    assert 98 < len(again) < 102
    assert set(again["raw"][:, 2].tolist()) == {2}
