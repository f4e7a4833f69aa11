"""Set points, scale and settings of a CANopen output node, without a bus."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.devices.config import ValvesConfig
from softloop.devices.protocols import canopen_output as co
from softloop.devices.valve_driver import DRIVER_OK, DRIVER_WATCHDOG, CanopenDriver
from softloop.wire.benchfile import load_model
from softloop.wire.can_frame import make_frame
from softloop.wire.errors import BadConfig

scales = st.builds(
    lambda off, low, span, low_ma, span_ma: co.Scale(off, low, low_ma, low + span, low_ma + span_ma),
    st.integers(-32768, 0),
    st.integers(0, 16000),
    st.integers(1, 16767),
    st.floats(0, 100),
    st.floats(1, 500),
)


@given(scales, st.floats(allow_nan=True, allow_infinity=True))
def test_no_current_above_what_was_asked_for_is_ever_given(scale, asked_ma):
    counts = scale.counts(asked_ma)
    co.encode_setpoints(counts, counts)  # an int16
    given_ma = scale.current_ma(counts)
    assert 0.0 <= given_ma <= scale.full_ma * (1 + 1e-9)
    if not asked_ma >= scale.low_ma:
        assert given_ma == 0.0
    else:
        step_ma = (scale.full_ma - scale.low_ma) / (scale.full_counts - scale.low_counts)
        assert given_ma <= asked_ma + 1e-5 * step_ma + 1e-9
        assert counts == scale.off_counts or asked_ma > scale.full_ma or given_ma >= asked_ma - step_ma - 1e-9


@given(scales, st.floats(0, 1000), st.floats(0, 1000))
def test_more_current_is_never_fewer_counts(scale, one, other):
    assert scale.current_ma(scale.counts(min(one, other))) <= scale.current_ma(scale.counts(max(one, other)))


@given(st.integers(-32768, 32767), st.integers(-32768, 32767))
def test_set_points_go_there_and_back(charge, exhaust):
    data = co.encode_setpoints(charge, exhaust)
    assert (len(data), co.decode_setpoints(data)) == (4, (charge, exhaust))


def plan(**node):
    config = ValvesConfig(driver="canopen_analog", canopen_analog=node)
    return config.node.plan(config.vent_current_ma)


def test_the_error_values_are_a_vent():
    held = {(s.index, s.sub): s.value for s in co.required_settings(plan(off_counts=-100))}
    assert (held[0x6443, 1], held[0x6443, 2]) == (1, 1)
    assert held[0x6444, 1] == -100 << 16
    assert held[0x6444, 2] >> 16 == int(200 / 220 * 32767)
    assert held[0x1016, 1] == 126 << 16 | 100
    assert held[0x1401, 5] == 20
    unshifted = {(s.index, s.sub): s.value for s in co.required_settings(plan(error_value_shift=0))}
    assert unshifted[0x6444, 2] == int(200 / 220 * 32767)


@given(st.integers(1, 4), st.integers(0, 1), st.integers(1, 125))
def test_a_pdo_is_off_and_empty_while_it_changes(rpdo, measured, node_id):
    settings = co.required_settings(plan(rpdo=rpdo, measured_index=0x6401 * measured, node_id=node_id))
    written, valid, entries = co.writing_order(settings), {}, {}
    for setting in written:
        assert len(setting.data) == setting.size
        communication, mapping = setting.index & 0xFE00 in (0x1400, 0x1800), setting.index & 0xFE00 in (0x1600, 0x1A00)
        if setting.is_identifier:
            valid[setting.index] = not setting.value & co.PDO_OFF
        elif setting.is_length:
            assert valid[setting.index - 0x200] is False
            entries[setting.index] = setting.value
        elif mapping:
            assert (valid[setting.index - 0x200], entries[setting.index]) == (False, 0)
        elif communication:
            assert valid[setting.index] is False
    assert set(valid.values()) == {True}
    assert set(entries.values()) == {2}
    last = {(s.index, s.sub): s.value for s in written}
    assert all(last[s.index, s.sub] == s.value for s in settings)


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_no_frame_breaks_the_adapter_and_only_an_operational_heartbeat_is_well(arbitration_id, data):
    for arbitrary in (arbitration_id, 0x701, 0x081, 0x181):
        driver = CanopenDriver(plan(measured_index=0x6401))
        said = driver.hear(make_frame(1, 0, 0, arbitrary, data))
        assert said in (None, DRIVER_OK, DRIVER_WATCHDOG)
        assert (said == DRIVER_OK) == (arbitrary == 0x701 and len(data) == 1 and data[0] & 0x7F == 5)
        assert all(-1 <= c <= 65535 for c in driver.coils)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"driver": "plc"}, "'driver': .*'rig', 'canopen_analog' or 'canopen_current'"),
        ({"canopen_analog": {"node": 3}}, "unknown key 'canopen_analog.node'; allowed here: charge_output, deadline_ms"),
        ({"canopen_analog": {"charge_output": 2}}, "exhaust_output must differ from charge_output .2."),
        ({"canopen_analog": {"node_id": 126}}, "gate_node_id must differ from node_id .126."),
        ({"canopen_analog": {"low_counts": 32767}}, "full_counts must be above low_counts .32767."),
        ({"canopen_current": {"low_ma": 650}}, "full_ma must be above low_ma .650."),
        ({"canopen_analog": {"off_counts": 5}}, r"off_counts must be low_counts \(0\) or outside"),
        (
            {"driver": "canopen_analog", "canopen_analog": {"full_ma": 200}},
            "current_max_ma must be at most canopen_analog.full_ma",
        ),
        (
            {"driver": "canopen_analog", "canopen_analog": {"low_ma": 210}},
            "vent_current_ma must be a current that canopen_analog",
        ),
        ({"driver": "canopen_current", "canopen_current": {"deadline_ms": 50}}, "canopen_current.deadline_ms is too long"),
        ({"driver": "canopen_current", "canopen_current": {"heartbeat_ms": 25}}, "canopen_current.heartbeat_ms is too long"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(tmp_path, content, message):
    with pytest.raises(BadConfig, match=message) as error:
        load_model(ValvesConfig, content, tmp_path / "bench.toml")
    assert "\n" not in str(error.value)
