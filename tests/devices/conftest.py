"""One Zenoh router for all tests of this room; each test joins it with sessions of its own."""

import pytest

from tests.wire.rendezvous import meeting


@pytest.fixture(scope="session")
def meet():
    """The configuration with which sessions join the router.

    As clients they have one way to each other, by the router, and what is sent first comes first. Peers have two: by the router
    until their direct link is up, and a busy machine may bring that up late, in the middle of a test. What is on the first way
    then is passed by what goes on the second, and counts as a gap. Nor may a link be given up for a pause of half a second.
    """
    with meeting("client", lease_ms=10_000) as config:
        yield config
