"""A hundredth of `make monitor`."""

from tests.campaigns.monitor import campaign


def test_a_hundredth_of_the_monitor_campaign():
    outcome = campaign(rigs=1, broken_rigs=1, seed=7)
    assert outcome.failures == []
    assert outcome.counts["fault-free rigs"] == 1
    assert outcome.counts["ticks on which Eq. 50 speaks"] > 0
    assert sum(n for what, n in outcome.counts.items() if what.endswith("violations seen")) == 5
