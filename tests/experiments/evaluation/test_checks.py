"""Tests of `experiments.evaluation.checks`."""

import math
from pathlib import Path
from xml.etree import ElementTree as ET

import pandas as pd
import pytest

from experiments.evaluation import metrics, tables
from experiments.evaluation.checks import Outcome, check, check_all
from experiments.scenario.settings import AnyScenario, Bound, Scenario
from mapfusion.errors import InputError
from tests.helpers.tiny_scenario import TINY, command


@pytest.fixture
def three(tmp_path: Path) -> list[Path]:
    """Scenarios a, b and c, without expectations."""
    text = TINY.partition("expect:")[0]
    for name in "abc":
        (tmp_path / f"{name}.yaml").write_text(text.replace("name: tiny", f"name: {name}"))
    return sorted(tmp_path.glob("*.yaml"))


def junit(path: Path) -> tuple[ET.Element, dict[str, ET.Element]]:
    root = ET.parse(path).getroot()
    cases = root.iter("testcase")
    return root, {f"{case.get('classname')}: {case.get('name')}": case for case in cases}


def test_one_that_cannot_run_ends_itself_alone(
    three: list[Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def run(scenario: AnyScenario, *_: object) -> Path:
        if scenario.name == "b" and scenario.seed == 1:
            raise InputError("scenario b: R1[/b]: the way leads through a wall\x1b")
        return tmp_path

    monkeypatch.setattr("experiments.evaluation.result.run_scenario", run)
    monkeypatch.setattr("experiments.evaluation.checks.check", lambda *_: [])
    monkeypatch.setattr("experiments.evaluation.checks.nothing_merged", lambda _: None)
    out = tmp_path / "deep" / "junit.xml"
    reply = command(capsys, "check", *three, "--seeds", "0..2", "--junit", out)
    assert reply.code == 2
    assert reply.complaints == ["mapfusion: scenario b: R1[/b]: the way leads through a wall\\x1b"]
    assert "1 of 3 scenarios could not be checked" in reply.out
    root, cases = junit(out)
    assert [root.get(name) for name in ("tests", "failures", "errors", "skipped")] == [*"8010"]
    assert {name for name in cases if name.startswith("b")} == {"b: run, seed 0", "b: run, seed 1"}
    error = cases["b: run, seed 1"].find("error")
    assert error is not None
    assert "through a wall" in str(error.get("message"))
    assert all(float(case.get("time", "x")) >= 0 for case in cases.values())
    assert [suite.get("name") for suite in root] == ["a", "b", "c"]


def test_none_is_run_where_one_cannot_be_read(
    three: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    three[1].write_text("schema_version: 1\nname: b\n")
    out = tmp_path / "junit.xml"
    reply = command(capsys, "check", *three, "nowhere", "--junit", out, "--results", tmp_path / "r")
    assert reply.code == 2
    assert len(reply.complaints) == 2
    assert not (tmp_path / "r").exists()
    root, cases = junit(out)
    assert [root.get(name) for name in ("tests", "errors", "skipped")] == [*"422"]
    assert cases["b: run"].find("error") is not None
    assert cases["nowhere: run"].find("error") is not None
    assert cases["a: run"].find("skipped") is not None


def test_a_defect_is_told_and_then_raised(three: list[Path]) -> None:
    def run(scenario: AnyScenario) -> Path:
        raise ZeroDivisionError("of ours")

    checks = check_all([str(three[0])], [0], (), run)
    told = next(checks)
    assert told.error == "ZeroDivisionError: of ours"
    assert list(told.elapsed_s) == [0]
    assert not told.passed
    with pytest.raises(ZeroDivisionError):
        next(checks)


@pytest.mark.parametrize(
    ("value", "low", "high", "passed"),
    [
        (1.0, None, 1.0, True),
        (1.0, 1.0, None, True),
        (1.0, 0.5, 1.5, True),
        (1.0 + 1e-12, None, 1.0, False),
        (1.0 - 1e-12, 1.0, None, False),
        (math.nan, None, 1.0, False),
        (math.nan, 0.0, None, False),
        (math.inf, 0.0, None, False),
    ],
)
def test_verdict(value: float, low: float | None, high: float | None, passed: bool) -> None:
    assert Outcome("s", "m", value, Bound(min=low, max=high), {0: value}).passed == passed


def test_bound_as_a_person_writes_it() -> None:
    texts = [
        Outcome("s", "m", 0, bound, {}).bound_text
        for bound in (Bound(min=1), Bound(max=2.5), Bound(min=1, max=2))
    ]
    assert texts == ["1 <= x", "x <= 2.5", "1 <= x <= 2"]


def test_check_pools_the_seeds(
    tiny: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two results whose path RMSEs are 1 and 3 m: by seed 1 and 3, pooled their median."""
    results = {}
    for seed, error_m in ((4, 1.0), (9, 3.0)):
        results[seed] = tmp_path / str(seed)
        row = dict.fromkeys(tables.ALL["robots"].names, 0.0) | {"robot": "R1", "resampled": False}
        rows = [row | {"path_error_m": error_m, "iteration": i} for i in range(3)]
        frame = pd.DataFrame(rows).astype({"n_landmarks": int})
        tables.write(tables.table_path(results[seed], "robots"), "robots", frame)
    monkeypatch.setattr(metrics, "USED_TABLES", ("robots",))
    scenario = tiny.model_copy(update={"expect": {"path_rmse_m": Bound(max=2)}})
    (outcome,) = check(scenario, results)
    assert outcome.per_seed == {4: 1.0, 9: 3.0}
    assert outcome.value == 2.0
    assert outcome.passed
