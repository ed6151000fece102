"""All kernels once with every index checked: none reads or writes outside of an array.

Compiled kernels check nothing, and to compile them with checks takes minutes. They are Python,
which NumPy checks as it runs: so in a process of its own none of them is compiled.
"""

import os
import subprocess
import sys

from experiments.pipeline.stage import SOURCE_ROOT


def test_kernels_stay_inside_their_arrays() -> None:
    own = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-m", "tests.bounds"],
        cwd=SOURCE_ROOT,
        env=os.environ | own,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
