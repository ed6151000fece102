"""What holds for all tests, and in which order files are tested."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# No test may depend on how fast the machine is; by default an example may take 0.2 s.
settings.register_profile("any_speed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any_speed")

_ALIGN = Path(__file__).parent / "mapfusion" / "align"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Second in line come the tests of the aligners, all others stay as they stand.

    The first of two workers begins with a whole run, which compiles the kernels of the front end
    and the filter. Meanwhile the second compiles the aligners', which that run then finds.
    """
    first = items[0].path if items else None
    items.sort(key=lambda item: (item.path != first, not item.path.is_relative_to(_ALIGN)))
