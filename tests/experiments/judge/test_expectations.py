import math
from pathlib import Path

import pandas as pd
import pytest

from experiments.evaluation import metrics, tables
from experiments.evaluation.checks import Outcome, check
from experiments.scenario.settings import Bound, Scenario


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
