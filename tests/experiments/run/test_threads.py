"""Whatever is loaded later, linear algebra runs in one thread."""

import json
import subprocess
import sys

_SCRIPT = """
import json
from experiments.pipeline.workers import single_threaded
single_threaded()
import numba, scipy.linalg, scipy.sparse.linalg, scipy.optimize
from threadpoolctl import threadpool_info
print(json.dumps([library["num_threads"] for library in threadpool_info()]))
"""


def test_libraries_that_are_loaded_afterwards_are_bound_too() -> None:
    """In a new process, as a worker is: several threads would sum in another order."""
    ended = subprocess.run(
        [sys.executable, "-c", _SCRIPT], capture_output=True, text=True, check=True
    )
    threads = json.loads(ended.stdout)
    assert len(threads) >= 2  # numpy's and scipy's own
    assert set(threads) == {1}
