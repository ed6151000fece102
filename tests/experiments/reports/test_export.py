"""The page of formats is true: it names what the schemas hold, and its example works."""

import re
from pathlib import Path

import numpy as np
import pytest

import mapfusion
from experiments.reports import export
from mapfusion.landmark_map import read_map
from tests.helpers.tiny_scenario import command


def test_the_page_is_what_the_schemas_say() -> None:
    text = export.PAGE.read_text(encoding="utf-8")
    assert text == export.page(text), "run: python -m experiments.reports.export"
    assert "| `cov_xy_m2` | double | m² | required |" in text
    assert "| `label` | int32 |  | -1 | known identity" in text


def test_maps_made_as_the_page_says_align_and_merge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    _, code = re.split("```python\n", export.PAGE.read_text(encoding="utf-8"))
    exec(code.partition("```")[0], {})
    maps = [read_map(Path(name)) for name in ("north.parquet", "south.parquet")]
    pairs = mapfusion.match(*maps)
    registration = mapfusion.Registration(mapfusion.make_aligner("ransac"))
    found = registration.register(*maps, pairs, np.random.default_rng(0)).applied
    np.testing.assert_allclose(found.T_a_b, [2.0, -1.0, 0.4], atol=0.02)
    reply = command(capsys, "merge", "north.parquet", "south.parquet", "-o", "fused.parquet")
    assert reply.code == 0, reply.err
    n_fused = len(read_map(Path("fused.parquet")))
    assert 60 <= n_fused <= 62  # of 60 points; the gate keeps 99 of 100 pairs
