"""A hundredth of `make kill`."""

from tests.campaigns.kill import campaign


def test_a_hundredth_of_the_kill_campaign():
    outcome = campaign(kills=2, cuts=20, full=2, seed=7)
    assert outcome.failures == []
    assert outcome.counts["recorders killed"] == 2
    assert outcome.counts["files cut"] == 20
