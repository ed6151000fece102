"""Where compiled kernels are kept: one folder for each state of the source.

Numba notices a change in a kernel's own file, not in a kernel that it calls from another file; a
folder named after all of the source cannot hand out an outdated one.
"""

import os
import shutil
from pathlib import Path

from experiments.run.code_version import source_hash

KERNELS = ("mapfusion", "sim/raycast", "sim/exposure.py")  # where there are any
_VERSIONS_KEPT = 4  # a few megabytes each; going back and forth between branches stays fast


def use_kernel_cache() -> None:
    """Tell Numba where to keep compiled kernels; to be called before it is first imported.

    A `NUMBA_CACHE_DIR` set by the user is left alone. Worker processes inherit the setting.
    """
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    cache_home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    root = cache_home / "mapfusion" / "kernels"
    folder = root / source_hash(KERNELS)[:16]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
    except OSError:  # a home that cannot be written to: Numba finds a place of its own
        return
    os.environ["NUMBA_CACHE_DIR"] = str(folder)
    versions = sorted(root.iterdir(), key=lambda path: path.stat().st_mtime, reverse=True)
    for outdated in versions[_VERSIONS_KEPT:]:
        shutil.rmtree(outdated, ignore_errors=True)
