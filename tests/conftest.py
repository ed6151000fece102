"""What holds for all tests."""

from hypothesis import HealthCheck, settings

# No test may depend on how fast the machine is; by default an example may take 0.2 s.
settings.register_profile("any_speed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any_speed")
