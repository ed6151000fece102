"""In which order files are tested."""

from pathlib import Path

import pytest

_ALIGN = Path(__file__).parent / "mapfusion" / "align"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Second in line come the tests of the aligners, all others stay as they stand.

    The first of two workers begins with a whole run, which compiles the kernels of the front end
    and the filter. Meanwhile the second compiles the aligners', which that run then finds.
    """
    first = items[0].path if items else None
    items.sort(key=lambda item: (item.path != first, not item.path.is_relative_to(_ALIGN)))
