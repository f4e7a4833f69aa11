"""Settings of all tests."""

import signal
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# Two noisy cores: how long one example takes says nothing about the code.
settings.register_profile("softloop", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("softloop")


# A shell that starts something in the background lets it ignore SIGINT, and all that it starts in turn.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_addoption(parser):
    parser.addoption("--real-data", metavar="DIR", help="measurements of real actuators; tests of them are skipped without it")


@pytest.fixture
def real_data(request):
    """The folder of real measurements."""
    folder = request.config.getoption("--real-data")
    if folder is None:
        pytest.skip("no real measurements given (pytest --real-data DIR)")
    return Path(folder)
