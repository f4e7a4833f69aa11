import struct

import cantools
import pytest
from e2e import p01
from hypothesis import given
from hypothesis import strategies as st

from softloop.devices.protocols import can_frames as cf
from softloop.devices.protocols.can_frames import Verdict
from softloop.wire.messages import names_of

U16, NIBBLE, COUNTER = st.integers(0, 65535), st.integers(0, 15), st.integers(0, 14)
EIGHT = st.binary(min_size=8, max_size=8)
CODECS = {
    "VALVE_COMMAND": (cf.VALVE_COMMAND_ID, cf.ValveCommandFrame, cf.encode_valve_command, cf.decode_valve_command),
    "VALVE_STATUS": (cf.VALVE_STATUS_ID, cf.ValveStatusFrame, cf.encode_valve_status, cf.decode_valve_status),
}
PROTECTED = pytest.mark.parametrize("name", CODECS)


@PROTECTED
@given(COUNTER, NIBBLE, U16, U16, U16)
def test_protected_frames_are_the_documented_bytes_and_come_back(name, counter, kind, charge, exhaust, seq):
    identifier, make, encode, decode = CODECS[name]
    data = encode(make(counter, kind, charge, exhaust, seq))
    assert data[1:] == struct.pack("<BHHH", counter | kind << 4, charge, exhaust, seq)
    assert decode(data) == make(counter, kind, charge, exhaust, seq)
    assert cf.E2eReceiver(identifier, 3).judge(data) == Verdict.OK


@given(st.integers(-32768, 32767), st.integers(-32768, 32767), st.integers(0, 255))
def test_analogue_frames_are_the_documented_bytes_and_come_back(supply, chamber, counter):
    data = cf.encode_analog_inputs(cf.AnalogFrame(supply, chamber, counter))
    assert data == struct.pack("<hhBxxx", supply, chamber, counter)
    assert cf.decode_analog_inputs(data) == (supply, chamber, counter)


@given(st.binary(min_size=2, max_size=64), U16)
def test_the_crc_is_that_of_the_autosar_library(data, data_id):
    protected = bytearray(data)
    p01.e2e_p01_protect(protected, data_id, increment_counter=False)
    assert cf.e2e_crc(data, data_id) == protected[0]


@PROTECTED
@given(COUNTER, NIBBLE, U16, U16, U16)
def test_every_single_bit_flip_is_caught(name, counter, kind, charge, exhaust, seq):
    identifier, make, encode, _ = CODECS[name]
    good = encode(make(counter, kind, charge, exhaust, seq))
    for bit in range(64):
        flipped = bytearray(good)
        flipped[bit // 8] ^= 1 << bit % 8
        assert cf.E2eReceiver(identifier, 3).judge(bytes(flipped)) == Verdict.WRONG_CRC


def test_a_frame_under_the_other_identifier_is_caught():
    data = cf.encode_valve_command(cf.ValveCommandFrame(3, 1, 2, 3, 4))
    assert cf.E2eReceiver(cf.VALVE_STATUS_ID, 3).judge(data) == Verdict.WRONG_CRC


@given(st.lists(st.binary(max_size=10), max_size=20))
def test_a_receiver_survives_any_bytes_and_counts_what_it_refused(frames):
    receiver = cf.E2eReceiver(cf.VALVE_STATUS_ID, 3)
    verdicts = [receiver.judge(data) for data in frames]
    assert receiver.rejected == sum(not v.usable for v in verdicts)
    assert all((v == Verdict.WRONG_LENGTH) == (len(d) != 8) for v, d in zip(verdicts, frames, strict=True))


@given(EIGHT)
def test_any_eight_bytes_decode(data):
    assert cf.decode_valve_command(data).charge_counts == struct.unpack_from("<H", data, 2)[0]
    assert cf.decode_valve_status(data).seq == struct.unpack_from("<H", data, 6)[0]
    assert cf.decode_analog_inputs(data).counter == data[4]


@pytest.mark.parametrize("decode", [cf.decode_valve_command, cf.decode_valve_status, cf.decode_analog_inputs])
@pytest.mark.parametrize("length", [0, 7, 9, 64])
def test_other_lengths_are_refused_with_a_line_for_a_person(decode, length):
    with pytest.raises(cf.BadFrame, match=f"has 8 data bytes, got {length}$"):
        decode(bytes(length))


@pytest.mark.parametrize("frame", [(15 + 1, 0, 0, 0, 0), (0, 0, 65536, 0, 0), (0, 0, -1, 0, 0)])
def test_numbers_that_do_not_fit_are_refused(frame):
    with pytest.raises(OverflowError):
        cf.encode_valve_command(cf.ValveCommandFrame(*frame))


def judge_counters(*counters, max_delta=3):
    receiver = cf.E2eReceiver(cf.VALVE_STATUS_ID, max_delta)
    frames = [cf.ValveStatusFrame(c, 0, 0, 0, 0) for c in counters]
    return [receiver.judge(cf.encode_valve_status(f)).name for f in frames], receiver


@pytest.mark.parametrize(
    ("counters", "verdicts"),
    [
        ((0, 1, 2), ["OK", "OK", "OK"]),
        ((14, 0), ["OK", "OK"]),
        ((5, 5, 6), ["OK", "REPEATED", "OK"]),
        ((0, 3), ["OK", "SOME_LOST"]),
        ((13, 1), ["OK", "SOME_LOST"]),
        ((0, 4, 5), ["OK", "WRONG_SEQUENCE", "OK"]),
        ((3, 2, 3), ["OK", "WRONG_SEQUENCE", "OK"]),
        ((0, 15, 1), ["OK", "WRONG_SEQUENCE", "OK"]),
    ],
)
def test_verdicts_by_the_counter(counters, verdicts):
    assert judge_counters(*counters)[0] == verdicts


def test_lost_and_rejected_frames_are_counted():
    receiver = judge_counters(0, 1, 3, 3, 6)[1]
    assert (receiver.lost, receiver.rejected) == (1 + 2, 1)


@given(COUNTER)
def test_counters_go_round_without_fifteen(counter):
    assert judge_counters(counter, cf.next_counter(counter))[0] == ["OK", "OK"]


def test_the_dbc_agrees_with_the_messages():
    database = cantools.database.load_file(cf.DBC_FILE)
    outputs = database.get_message_by_name("VALVE_COMMAND").get_signal_by_name("OUTPUT").choices
    assert {v: str(n).lower() for v, n in outputs.items()} == names_of("ValveStatus", "OUTPUT_")
    assert [m.frame_id for m in database.messages] == [0x080, 0x090, 0x100]
