"""Order of test files, and their distribution to workers."""

from pathlib import Path
from typing import Any

import pytest
import scipy.linalg  # noqa: F401  # its threads are limited only once it is there
from hypothesis import HealthCheck, settings
from xdist.scheduler import LoadFileScheduling

from experiments.pipeline.stage import use_kernel_cache
from experiments.pipeline.workers import single_threaded

# No test may depend on how fast the machine is; by default an example may take 0.2 s.
settings.register_profile("any_speed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any_speed")

# Tests, commands and the processes that they start share the kernels that any of them compiled.
use_kernel_cache()

# Threads that wait for one another in small products take many times as long on a busy machine.
single_threaded()

_TESTS = Path(__file__).parent
# Who comes first compiles: of two workers one the aligners' kernels, one all others. Whole runs,
# which take both, find them there.
_COMPILE = (("mapfusion/align",), ("mapfusion/fastslam", "mapfusion/vision", "sim/rendering"))


def _place(path: Path) -> int:
    """Return the index of the package that a file tests; files of no package come last."""
    for place, packages in enumerate(_COMPILE):
        if any(path.is_relative_to(_TESTS / package) for package in packages):
            return place
    return len(_COMPILE)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of kernels first, all others as they stand."""
    items.sort(key=lambda item: _place(item.path))


class _Scheduling(LoadFileScheduling):
    """A file's tests go to one worker, and so do all tests of the same packages of kernels."""

    def _split_scope(self, nodeid: str) -> str:
        file = super()._split_scope(nodeid)
        place = _place(Path(__file__).parents[1] / file)
        return file if place == len(_COMPILE) else f"kernels {place}"


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> _Scheduling:
    """Return the key by which `-n 2` distributes tests."""
    return _Scheduling(config, log)
