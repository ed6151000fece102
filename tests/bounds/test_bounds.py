"""All kernels once with Numba's bounds checks on: none reads or writes outside of an array.

A kernel in the cache ignores the flag, and a process reads it once: so a process of its own, with
an empty cache. The machine code is not optimised, which saves a quarter of the time to compile.
"""

import os
import subprocess
import sys
from pathlib import Path

from experiments.run.code_version import SOURCE_ROOT


def test_kernels_stay_inside_their_arrays(tmp_path: Path) -> None:
    own = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_OPT": "0", "NUMBA_CACHE_DIR": str(tmp_path)}
    own |= {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-W", "ignore", "-m", "tests.bounds.all_kernels"]
    done = subprocess.run(
        command, cwd=SOURCE_ROOT, env=os.environ | own, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
