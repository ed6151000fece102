"""What two versions are compared in, read back from tables whose values are known."""

from pathlib import Path

import pytest

from experiments.study.compare.versions import compare
from tests.helpers.made_up_runs import Tables, two_sweeps


def row(found, metric: str, method: str) -> dict:
    rows = found.table[(found.table["metric"] == metric) & (found.table["method"] == method)]
    (only,) = rows.to_dict("records")
    return only


def changed(seed: int, made: Tables) -> Tables:
    """RANSAC's refined errors are doubled; of one pair the second version has 2 true pairs."""
    errors = made["errors"]
    errors.loc[errors["aligner"] == "ransac", "refined_translation_error_m"] *= 2
    errors.loc[errors["robot_b"] == "R3", "n_true"] = 2
    made["map_fits"]["rmse_m"] *= 3
    return made


def test_values_and_counts_are_those_of_the_tables(tmp_path: Path) -> None:
    found = compare(*two_sweeps(tmp_path, changed, seeds=6))
    over = row(found, "refined / oracle", "ransac")
    assert (over["a"], over["b"], over["change"]) == pytest.approx((1.01, 2.02, 2.0), rel=1e-6)
    # 6 runs of 2 pairs at 4 iterations; where either version has too few pairs it does not count
    assert row(found, "success refined", "icp")["n_rows"] == 6 * 2 * 4
    assert row(found, "estimated error, m", "icp")["n_rows"] == 6 * 4
    assert row(found, "true pairs", "")["n_rows"] == 6 * 4
    assert row(found, "landmark RMSE, m", "")["change"] == pytest.approx(3.0)
    assert row(found, "landmark RMSE, m", "")["n_rows"] == 6 * 3
    assert row(found, "fused RMSE, m", "")["n_rows"] == 6
    path = row(found, "path RMSE, m", "")
    assert (path["change"], path["n_rows"], path["verdict"]) == (1.0, 6 * 3, "identical")
