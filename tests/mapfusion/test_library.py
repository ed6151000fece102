"""The names that `import mapfusion` offers, and the page that shows them."""

import ast
import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mapfusion
from mapfusion.errors import MOVED_MODULES
from mapfusion.geometry.se2 import between, wrap

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "library.md"


def test_importing_it_imports_nothing_else():
    code = (
        "import sys, mapfusion; print([m for m in ('numpy', 'numba', 'cv2') if m in sys.modules])"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "[]"


def test_editors_see_the_names_that_exist():
    stub = Path(mapfusion.__file__).with_suffix(".pyi")
    seen = {
        alias.asname: (node.module, alias.name)
        for node in ast.parse(stub.read_text()).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    seen["fuse_maps"] = seen.pop("_merge")
    assert sorted(seen) == mapfusion.__all__
    for name, (module, called_there) in seen.items():
        assert getattr(mapfusion, name) is getattr(sys.modules[module], called_there)
    assert set(mapfusion.__all__) < set(dir(mapfusion))


def test_the_version_is_the_package_s():
    assert re.fullmatch(r"\d+\.\d+\.\d+.*", mapfusion.__version__)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'fast_slam'"):
        _ = mapfusion.fast_slam


def test_the_page_s_example_gives_the_map_of_both_robots(tmp_path: Path):
    code = "\n".join(re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL))
    told: dict[str, Any] = {"folder": tmp_path}
    exec(compile(code, str(PAGE), "exec"), told)
    T_a_b = between(*(np.array(start) for start in told["starts"].values()))
    error = told["alignment"].T_a_b - T_a_b
    assert np.hypot(*error[:2]) < 0.15
    assert abs(wrap(error[2])) < 0.05
    assert told["common"].sum() > 30
    orb = told["orb_merged"]
    np.testing.assert_allclose(orb.alignments[0, 1].T_a_b, [3, -1, 0.5], atol=0.02)
    assert (tmp_path / "orb.png").stat().st_size > 10_000
    written = mapfusion.read_map(tmp_path / "orb.csv")
    assert str(written.descriptor_kind) == "hamming, 256 bits"
    assert len(written) == 80
    fused = mapfusion.read_map(tmp_path / "fused.parquet")
    assert len(fused) == len(told["map_a"]) + len(told["map_b"]) - told["common"].sum()


def test_the_page_names_all_that_is_offered():
    table = PAGE.read_text().split("## ")[0]
    assert {name for name in mapfusion.__all__ if f"`{name}`" not in table} == set()


@pytest.mark.parametrize(("former", "new"), MOVED_MODULES.items())
def test_former_modules_are_gone_and_the_named_ones_exist(former: str, new: str):
    assert importlib.util.find_spec(new) is not None
    with pytest.raises(ImportError):
        importlib.import_module(former)
