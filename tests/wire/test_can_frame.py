"""CAN frames: their bytes are the message's, and python-can's messages pass unchanged or are refused."""

from __future__ import annotations

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.wire.can_frame import FLAG_EXTENDED, FLAG_REMOTE, CanFrame, from_message, pack_frame, to_message, unpack_frame
from softloop.wire.messages import message


@given(
    st.integers(0, 2**64 - 1), st.integers(-(2**63), 2**63 - 1), st.integers(0, 2**29 - 1), st.binary(max_size=8), st.booleans()
)
def test_frame_bytes_are_those_of_the_message_definition(seq, stamp_ns, arbitration_id, data, remote):
    flags = FLAG_EXTENDED | (FLAG_REMOTE if remote else 0)
    frame = CanFrame(seq, stamp_ns, seq, arbitration_id, flags, len(data), data.ljust(8, b"\0"))
    kind = message("CanFrame")
    assert CanFrame._fields == kind.Tuple._fields
    assert pack_frame(frame) == kind.pack(frame)
    assert unpack_frame(pack_frame(frame)) == frame
    there = kind.unpack(pack_frame(frame))
    assert (*there[:-1], bytes(there.data)) == frame


@given(
    st.builds(
        can.Message,
        arbitration_id=st.integers(-5, 2**29 + 5),
        is_extended_id=st.booleans(),
        is_remote_frame=st.booleans(),
        is_error_frame=st.booleans(),
        dlc=st.none() | st.integers(-1, 10),
        data=st.binary(max_size=10),
        is_fd=st.booleans(),
    )
)
def test_a_message_is_carried_as_it_is_or_refused(msg):
    if msg.is_error_frame and not msg.data and msg.dlc == 8:
        msg.data = bytearray(8)  # the short way to write one
    try:
        msg._check()
        possible = not msg.is_fd
    except ValueError:
        possible = False
    if not possible:
        with pytest.raises(ValueError, match="FD" if msg.is_fd else "classic CAN frame|bytes of data"):
            from_message(msg, 1, 2, 3)
        return
    frame = from_message(msg, 1, 2, 3)
    assert unpack_frame(pack_frame(frame)) == frame
    assert to_message(frame, "c", is_rx=True).equals(msg, timestamp_delta=None, check_channel=False)
