"""The struct path and the numpy view of every message are what rosbags writes, bit for bit."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from softloop.wire.channels import CHANNELS
from softloop.wire.messages import BadPayload, constant, message, message_names, names_of

NUMBERS = {
    "float64": st.floats(width=64),
    "int64": st.integers(-(2**63), 2**63 - 1),
    "uint64": st.integers(0, 2**64 - 1),
    "uint32": st.integers(0, 2**32 - 1),
    "uint8": st.integers(0, 255),
}


def values_of(kind):
    def field(f):
        one = NUMBERS[f.base]
        return st.tuples(*[one] * f.length) if f.length else one

    return st.fixed_dictionaries({f.name: field(f) for f in kind.fields})


def library_bytes(kind, values):
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(kind.text, kind.ros_name))
    arrays = {f.name: np.array(values[f.name], dtype=f.base) if f.length else values[f.name] for f in kind.fields}
    return bytes(store.serialize_cdr(store.types[kind.ros_name](**arrays), kind.ros_name))


@pytest.mark.parametrize("name", message_names())
@given(data=st.data())
def test_struct_and_record_equal_the_library(name, data):
    kind = message(name)
    values = data.draw(values_of(kind))
    packed = kind.pack(kind.make(**values))
    assert packed == library_bytes(kind, values)
    assert kind.pack(kind.unpack(packed)) == packed
    slot = np.zeros(1, kind.dtype)
    kind.unpack_into(packed, slot.view(np.uint8))
    # Padding inside the struct stays zero in both forms.
    assert kind.pack_record(slot[0]) == packed


@pytest.mark.parametrize("name", message_names())
@given(payload=st.binary(max_size=700))
def test_any_bytes_are_refused_or_read(name, payload):
    kind = message(name)
    if len(payload) == kind.size and payload[:4] == b"\x00\x01\x00\x00":
        kind.unpack(payload)
        return
    with pytest.raises(BadPayload, match=name):
        kind.unpack(payload)
    with pytest.raises(BadPayload, match=name):
        kind.unpack_into(payload, np.zeros(1, kind.dtype).view(np.uint8))


def test_records_have_attributes_and_constants_their_values():
    record = np.zeros(1, message("CycleRecord").dtype)[0]
    record.error_deg = 1.5
    record.theta[3] = 7.0
    assert message("CycleRecord").unpack(message("CycleRecord").pack_record(record)).theta[3] == 7.0
    assert constant("ValveStatus", "GATE_FAULT") == 2
    assert names_of("ValveStatus", "GATE_") == {0: "disarmed", 1: "armed", 2: "fault"}


def test_a_value_that_does_not_fit_is_an_error():
    kind = message("Event")
    with pytest.raises(struct.error):
        kind.pack(kind.make(code=256))
    assert math.isnan(kind.unpack(kind.pack(kind.make(value=math.nan))).value)


def test_every_channel_has_its_message_with_seq_and_stamp_first():
    for channel in CHANNELS:
        assert [f.name for f in message(channel.message).fields][:2] == ["seq", "stamp_ns"]
