import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.dynamics.parameters import (
    KV1_CHARGE,
    KV1_EXHAUST,
    KV6_CHARGE,
    KV6_EXHAUST,
    LEAK,
    load_parameters,
    model_record,
    shipped,
)
from softloop.dynamics.pneumatics import known_terms, pressure_rate
from softloop.dynamics.valve import current_for_area, g3, g4, orifice_area

MODEL = model_record(load_parameters(shipped()))
SHAPE, KV1, KV6 = MODEL.charge, MODEL.theta[KV1_CHARGE], MODEL.theta[KV6_CHARGE]
GAUGE = st.floats(0, 2e5)
CHAMBER = st.floats(1.0, 150.0)


@given(st.floats(0, 220), GAUGE, GAUGE)
def test_the_area_stays_between_its_stops_and_inverts(current, up, down):
    area = orifice_area(SHAPE, KV1, KV6, current, up, down)
    assert 0.0 <= area <= SHAPE.area_max_m2
    if 0.0 < area < SHAPE.area_max_m2:
        assert current_for_area(SHAPE, KV1, KV6, area, up, down) == pytest.approx(current, rel=1e-9)


@given(GAUGE, GAUGE)
def test_eqs_22_and_23_as_printed(up, down):
    denominator = 1 - SHAPE.k_v2_pa * up + SHAPE.k_v4_pa * down
    assert g3(SHAPE, up, down) == pytest.approx(1 / denominator)
    assert g4(SHAPE, up, down) == pytest.approx((-SHAPE.k_v3_m2_pa * up + SHAPE.k_v5_m2_pa * down) / denominator)


def test_the_dead_zone_is_sixty_milliamperes_without_pressure():
    assert current_for_area(SHAPE, KV1, KV6, 0.0, 0.0, 0.0) == pytest.approx(60.0)
    assert orifice_area(SHAPE, KV1, KV6, 59.9, 0.0, 0.0) == 0.0
    assert orifice_area(SHAPE, KV1, KV6, 60.1, 0.0, 0.0) > 0.0


@given(st.floats(100, 160), CHAMBER)
def test_eq_25_is_eq_11_where_one_valve_is_open(current, chamber):
    theta = MODEL.theta
    for charging, k1, k6 in ((True, KV1_CHARGE, KV6_CHARGE), (False, KV1_EXHAUST, KV6_EXHAUST)):
        f1, f2, f3 = known_terms(MODEL, charging, 200.0, chamber)
        regressor_form = f1 * (theta[k1] * current - theta[k6]) + f2 - f3 * theta[LEAK]
        currents = (current, 0.0) if charging else (0.0, current)
        assert pressure_rate(MODEL, theta, 200.0, chamber, *currents) == pytest.approx(regressor_form, rel=1e-9)


@given(CHAMBER)
def test_charge_raises_exhaust_lowers_and_the_leak_lowers(chamber):
    assert pressure_rate(MODEL, MODEL.theta, 200.0, chamber, 220.0, 0.0) > 0
    assert pressure_rate(MODEL, MODEL.theta, 200.0, chamber, 0.0, 220.0) < 0
    assert pressure_rate(MODEL, MODEL.theta, 200.0, chamber, 0.0, 0.0) < 0
