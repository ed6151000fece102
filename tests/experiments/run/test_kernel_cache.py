"""Compiled kernels: none is outdated, none is compiled anew for what it does not call."""

import json
import os
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from experiments.pipeline.code_version import PACKAGES, SOURCE_ROOT

KERNELS = {
    "callee": "@njit(cache=True)\ndef callee(x):\n    return x + 1\n",
    "caller": "from mapfusion.callee import callee\n"
    "@njit(cache=True)\ndef caller(x):\n    return 2 * callee(x)\n",
    "apart": "@njit(cache=True)\ndef apart(x):\n    return 3 * x\n",
}
CALL = """
import importlib, json
from experiments.pipeline.code_version import use_kernel_cache
use_kernel_cache()
told = {}
for name in ("caller", "apart"):
    kernel = getattr(importlib.import_module("mapfusion." + name), name)
    told[name] = kernel(10), bool(kernel.stats.cache_hits)
print(json.dumps(told))
"""


class Source:
    """A copy of ours with three kernels more, in an environment of its own."""

    def __init__(self, folder: Path) -> None:
        self._root, self.cache = folder / "source", folder / "cache"
        for package in PACKAGES:
            unwanted = shutil.ignore_patterns("__pycache__")
            shutil.copytree(SOURCE_ROOT / package, self._root / package, ignore=unwanted)
        for name, text in KERNELS.items():
            self.write(name, text)

    def write(self, module: str, text: str) -> None:
        """Put a module of kernels in place."""
        path = self._root / "mapfusion" / f"{module}.py"
        path.write_text("from numba import njit\n" + text, encoding="utf-8")

    def called(self) -> dict[str, list[object]]:
        """What the kernels give for 10, and whether they had been compiled before."""
        left_out = {"NUMBA_CACHE_DIR", "NUMBA_CACHE_LOCATOR_CLASSES", "PYTHONPATH"}
        environment = {name: value for name, value in os.environ.items() if name not in left_out}
        environment["XDG_CACHE_HOME"] = str(self.cache)
        # Python tells versions of a module apart by size and whole seconds; tests are faster
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
        asked = partial(subprocess.run, [sys.executable, "-c", CALL], cwd=self._root)
        told = asked(env=environment, capture_output=True, text=True, check=True)
        return json.loads(told.stdout)

    @property
    def folders(self) -> set[str]:
        """Those of the kernels' modules, without what their names say of the source."""
        kept = (self.cache / "mapfusion" / "kernels").iterdir()
        return {folder.name.rpartition("-")[0] for folder in kept}


@pytest.fixture
def source(tmp_path: Path) -> Source:
    """Called once."""
    source = Source(tmp_path)
    assert source.called() == {"caller": [22, False], "apart": [30, False]}
    return source


def test_kernels_are_compiled_once(source: Source) -> None:
    assert source.called() == {"caller": [22, True], "apart": [30, True]}
    assert source.folders == {"mapfusion.callee", "mapfusion.caller", "mapfusion.apart"}


def test_a_kernel_is_compiled_anew_when_one_that_it_calls_has_changed(source: Source) -> None:
    source.write("callee", KERNELS["callee"].replace("x + 1", "x + 2"))
    assert source.called() == {"caller": [24, False], "apart": [30, True]}
    source.write("callee", KERNELS["callee"])
    assert source.called() == {"caller": [22, True], "apart": [30, True]}


def test_of_a_module_few_versions_are_kept(source: Source) -> None:
    for k in range(5):
        source.write("callee", KERNELS["callee"].replace("x + 1", f"x + {3 + k}"))
        source.called()
    kept = [path.name for path in (source.cache / "mapfusion" / "kernels").iterdir()]
    # the last call leaves one more than it found
    assert sum(name.startswith("mapfusion.caller-") for name in kept) == 5
    assert sum(name.startswith("mapfusion.apart-") for name in kept) == 1


def test_a_kernel_that_numba_cannot_keep_is_compiled_each_time(source: Source) -> None:
    """It has a large global array, of which the code holds nothing but the place in memory."""
    large = "import numpy as np\nTABLE = np.ones(1_000_000)\n"
    source.write("apart", large + KERNELS["apart"].replace("3 * x", "3 * x * TABLE[x]"))
    for _ in range(2):
        assert source.called() == {"caller": [22, True], "apart": [30, False]}
