"""Tests of the output files: tables, JSON documents, JUnit reports."""

import math
import re
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

import mapfusion
from experiments.evaluation.metrics import CheckedScenario, Outcome
from experiments.reports import export
from experiments.reports.export import write_junit
from experiments.scenario.settings import Bound
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


def test_junit_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "junit.xml"
    outcomes = [
        Outcome("quick", "fine", 0.5, Bound(max=1), {0: 0.4, 1: 0.6}),
        Outcome("quick", "bad <&>", 2, Bound(max=1), {0: 2}),
        Outcome("paper", "unknown", math.nan, Bound(min=1), {0: math.nan}),
    ]
    checks = [
        CheckedScenario("quick", outcomes[:2], elapsed_s={0: 1.5, 1: 2.25}),
        CheckedScenario("paper", outcomes[2:], elapsed_s={0: 4.0}),
    ]
    write_junit(path, checks)
    root = ET.parse(path).getroot()
    assert (root.get("tests"), root.get("failures"), root.get("time")) == ("6", "2", "7.750")
    assert root[0].get("time") == "3.750"
    cases = {case.get("name"): case for case in root.iter("testcase")}
    assert cases["run, seed 1"].get("time") == "2.250"
    assert cases["fine"].find("failure") is None
    failure = cases["bad <&>"].find("failure")
    assert failure is not None
    assert failure.get("message") == "2, expected x <= 1; by seed 0: 2"
    assert cases["unknown"].find("failure") is not None
    assert cases["unknown"].get("classname") == "paper"
