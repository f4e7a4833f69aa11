"""One Zenoh router for all tests of this room; each test joins it with sessions of its own."""

import pytest

from tests.wire.rendezvous import meeting


@pytest.fixture(scope="session")
def meet():
    """The configuration with which sessions join the router."""
    with meeting() as config:
        yield config
