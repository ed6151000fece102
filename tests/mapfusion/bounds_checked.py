"""Run the quick tests of all kernels in this process, and see that each kernel was compiled in it.

Started by `test_bounds.py` with NUMBA_BOUNDSCHECK=1.
"""

import importlib
import pkgutil
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba import njit
from numba.core.registry import CPUDispatcher

import experiments
import mapfusion

HERE = Path(__file__).parent
# The tests that reach the kernels with small arrays; compiling is what takes the time here.
FILES = [
    "fastslam/test_filter_twin.py",
    "fastslam/test_particles.py",
    "align/test_aligners.py",
    "align/test_consistency.py",
    "align/test_correspondences.py",
    "align/test_drift.py",
    "align/test_false_alarms.py",
    "align/test_leverage.py",
    "align/test_max_clique.py",
    "align/test_refine.py",
    "test_symmetric.py",
    "vision",
    "../experiments/study/refusal/test_refusal.py::test_calibration_counts_every_motion_of_two_pairs",
]
# Left out: many repetitions of what another test does once.
NOT = ["covers", "stated_rate", "least_squares_solver", "copies and (0.0 or 0.5 or motion)"]


@njit
def _beyond(values: np.ndarray) -> float:
    return values[len(values)]


def kernels() -> dict[str, CPUDispatcher]:
    """All kernels of ours by name."""
    found = {}
    for package in (mapfusion, experiments):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            for name, value in vars(importlib.import_module(module.name)).items():
                if isinstance(value, CPUDispatcher):
                    found[f"{value.py_func.__module__}.{name}"] = value
    return found


def main() -> int:
    """Exit code 1 if a test failed, or if a kernel was not reached."""
    with pytest.raises(IndexError):  # the checks are on
        _beyond(np.zeros(3))
    chosen = " and ".join(f"not ({names})" for names in NOT)
    files = [str(HERE / name) for name in FILES]
    code = pytest.main(["-q", "-x", "-p", "no:cacheprovider", "-k", chosen, *files])
    unreached = sorted(name for name, kernel in kernels().items() if not kernel.signatures)
    sys.stdout.write(f"not reached: {unreached}\n")
    return int(code) or bool(unreached)


if __name__ == "__main__":
    assert numba.config.BOUNDSCHECK
    sys.exit(main())
