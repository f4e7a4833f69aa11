"""A hundredth of `make fuzz`."""

import pytest

from tests.campaigns.fuzz import BYTES, campaign


@pytest.mark.parametrize("target", [*BYTES, "gate"])
def test_a_hundredth_of_the_fuzz_campaign(target):
    outcome = campaign([target], 10_000, "own", seed=5)
    assert outcome.failures == []
    assert sum(outcome.counts.values()) >= 10_000 * (0.5 if target == "gate" else 1.0)
