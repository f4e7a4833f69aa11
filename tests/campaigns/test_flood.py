"""A short run of `make flood`."""

import pytest

from tests.campaigns.flood import WHO, campaign

pytestmark = pytest.mark.long


def test_a_rig_beside_attackers_stays_armed_and_hears_nothing_of_them():
    outcome = campaign(seconds=5.0, rounds=1, mode="client")
    assert outcome.failures == []
    assert outcome.counts["ticks under attack"] > 500
    assert outcome.counts["messages put by one without the right"] > 100
    assert all(outcome.counts[f"links tried by {who}"] > 0 for who, _, _ in WHO)
    assert sum(outcome.counts[f"links had by {who}"] for who, _, _ in WHO[:-1]) == 0
