import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.dynamics import bending
from softloop.dynamics.parameters import load_parameters, model_record, shipped

MODEL = model_record(load_parameters(shipped()))
ANGLES, RATES, PRESSURES = st.floats(0, 200), st.floats(-200, 200), st.floats(0, 150)


def test_the_rest_angle_of_table_1():
    assert bending.rest_angle(MODEL.theta) == pytest.approx(26.75, abs=0.01)


def test_the_static_map_of_table_1():
    for pressure, angle in ((20, 43.3), (40, 60.9), (60, 79.9), (80, 100.3), (100, 122.1), (150, 182.5)):
        assert bending.pressure_for(MODEL.theta, angle, 0.0, 0.0) == pytest.approx(pressure, abs=0.06)


@given(ANGLES, RATES, PRESSURES)
def test_drift_is_regressor_times_parameters(y, v, p):
    phi = np.zeros(9)
    bending.fill_phi_a(y, v, phi)
    assert bending.bending_drift(MODEL.theta, y, v) == pytest.approx(phi[:8] @ MODEL.theta[:8], rel=1e-9, abs=1e-6)
    printed = -(89.9733 - 0.1875 * y + 2.8943e-4 * y**2) * y + 64.3797 * p + 2277.8173
    printed -= (15.4547 - 6.964e-2 * y + 8.0505e-5 * y**2 + 5.0667e-7 * y**3) * v
    assert bending.bending_acceleration(MODEL.theta, y, v, p) == pytest.approx(printed, rel=1e-9, abs=1e-6)


@given(ANGLES, RATES)
def test_slopes_are_derivatives(y, v):
    theta, h = MODEL.theta, 1e-4
    by_angle = (bending.bending_drift(theta, y + h, v) - bending.bending_drift(theta, y - h, v)) / (2 * h)
    by_rate = (bending.bending_drift(theta, y, v + h) - bending.bending_drift(theta, y, v - h)) / (2 * h)
    assert bending.drift_slope_angle(theta, y, v) == pytest.approx(by_angle, rel=1e-5, abs=1e-4)
    assert bending.drift_slope_rate(theta, y) == pytest.approx(by_rate, rel=1e-5, abs=1e-4)


@given(ANGLES, RATES, st.floats(-5000, 5000))
def test_pressure_for_inverts_the_acceleration(y, v, acceleration):
    p = bending.pressure_for(MODEL.theta, y, v, acceleration)
    assert bending.bending_acceleration(MODEL.theta, y, v, p) == pytest.approx(acceleration, abs=1e-6)
