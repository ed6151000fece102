"""All kernels once with Numba's bounds checks on: none reads or writes outside of an array.

A kernel in the cache ignores the flag, and a process reads it once: so a process of its own, with
an empty cache, runs the tests of the kernels.
"""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_kernels_stay_inside_their_arrays(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-m", "tests.mapfusion.bounds_checked"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
