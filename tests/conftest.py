"""Settings of all tests."""

from hypothesis import HealthCheck, settings

# Two noisy cores: how long one example takes says nothing about the code.
settings.register_profile("softloop", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("softloop")
