import math
from pathlib import Path
from xml.etree import ElementTree as ET

import pandas as pd
import pytest

from experiments.judge import metrics, tables
from experiments.judge.expectations import Outcome, check, parse_seeds, write_junit
from experiments.scenario.settings import Bound, Scenario
from mapfusion.errors import InputError


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


def test_junit_is_read_back(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "junit.xml"
    outcomes = [
        Outcome("quick", "fine", 0.5, Bound(max=1), {0: 0.4, 1: 0.6}),
        Outcome("quick", "bad <&>", 2, Bound(max=1), {0: 2}),
        Outcome("paper", "unknown", math.nan, Bound(min=1), {0: math.nan}),
    ]
    write_junit(path, outcomes)
    suite = ET.parse(path).getroot()
    assert (suite.get("tests"), suite.get("failures")) == ("3", "2")
    cases = {case.get("name"): case for case in suite.iter("testcase")}
    assert cases["fine"].find("failure") is None
    failure = cases["bad <&>"].find("failure")
    assert failure is not None
    assert failure.get("message") == "2, expected x <= 1; by seed 0: 2"
    assert cases["unknown"].find("failure") is not None
    assert cases["unknown"].get("classname") == "paper"


def test_seeds() -> None:
    assert parse_seeds("3") == [3]
    assert parse_seeds("0..4") == [0, 1, 2, 3, 4]
    assert parse_seeds("5,2,0") == [5, 2, 0]
    assert len(parse_seeds("0..999")) == 1000
    with pytest.raises(InputError, match="more than 1000"):
        parse_seeds("0..1000")


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
