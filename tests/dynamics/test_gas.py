import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softloop.dynamics import gas

RATIOS = st.floats(0.0, 1.0)


def test_the_corrected_constants_meet_at_the_critical_ratio_with_equal_slope():
    assert pytest.approx(0.0404184, abs=1e-7) == gas.C1
    assert pytest.approx(0.1561738, abs=1e-7) == gas.C2
    assert pytest.approx(0.5282818, abs=1e-7) == gas.CRITICAL_RATIO
    above = gas.flow_function(gas.CRITICAL_RATIO + 1e-9)
    assert above == pytest.approx(gas.C1, rel=1e-12)
    slope = (gas.flow_function(gas.CRITICAL_RATIO + 1e-5) - gas.C1) / 1e-5
    assert abs(slope) < 1e-4


def test_the_printed_constants_would_leave_a_jump():
    printed_c1 = np.sqrt(1.4 / 287 * (2 / 2.4) ** (0.4 / 2.4))
    printed_c2 = np.sqrt(2 * 1.4 / (287 * 2.4))
    r = 0.528
    right = printed_c2 * r ** (1 / 1.4) * np.sqrt(1 - r ** (0.4 / 1.4))
    assert right / printed_c1 == pytest.approx(0.24, abs=0.005)


@given(RATIOS, RATIOS)
def test_flow_falls_with_the_pressure_ratio_and_ends_at_zero(a, b):
    low, high = min(a, b), max(a, b)
    assert gas.flow_function(low) >= gas.flow_function(high) - 1e-15
    assert gas.flow_function(1.0) == 0.0


def test_the_laminar_zone_joins_without_a_step():
    edge = gas.LAMINAR_RATIO
    assert gas.flow_function(edge + 1e-12) == pytest.approx(gas.flow_function(edge), rel=1e-6)


PRESSURES = st.floats(1e5, 4e5)


@given(PRESSURES, PRESSURES)
def test_flow_changes_sign_with_direction(a, b):
    assert gas.mass_flux(a, b, 293.15, 0.8) == -gas.mass_flux(b, a, 293.15, 0.8)
