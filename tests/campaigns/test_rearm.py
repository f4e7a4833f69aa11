"""A hundredth of `make rearm`."""

from tests.campaigns.rearm import LAWS, campaign


def test_a_hundredth_of_the_rearm_campaign():
    outcome = campaign(rigs=1, seed=7)
    assert outcome.failures == []
    assert outcome.counts["armed again"] == 2 * len(LAWS)
