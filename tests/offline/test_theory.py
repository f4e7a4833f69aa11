"""Eqs. 50 and 51 in simulated runs: with parametric mismatch only, adaptation takes the error to the noise floor."""

import pytest

from softloop.offline.theory import compare


@pytest.fixture(scope="module", params=[0, 2])
def rig(request):
    return compare(request.param)


def test_v3_falls_and_adaptation_takes_the_error_down(rig):
    assert rig["arc"]["v3_end"] < rig["arc"]["v3_start"]
    assert rig["ratio"]["t2_rms_deg"] < 0.8
    assert rig["ratio"]["t1_steady_deg"] < 0.53  # the paper's own ratio, with all of its disturbances


def test_the_error_surface_stays_inside_the_ultimate_bound(rig):
    for law in ("smc", "arc"):
        assert 0.0 < rig[law]["s1_max_deg_s"] < rig["s1_bound_deg_s"]
