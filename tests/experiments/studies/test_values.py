"""What two versions are compared in, read back from tables whose values are known."""

import numpy as np
import pandas as pd
import pytest

from experiments.studies.comparison import READ, VersionComparison, compare
from tests.helpers.made_up_runs import Tables, tables_of, two_sweeps


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


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> VersionComparison:
    return compare(*two_sweeps(tmp_path_factory.mktemp("versions"), changed, seeds=6))


def test_values_and_counts_are_those_of_the_tables(found: VersionComparison) -> None:
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


def test_what_is_told_of_either_version_is_a_median_of_errors_and_a_mean_of_shares(
    found: VersionComparison,
) -> None:
    made = [tables_of(seed) for seed in range(6)]
    fits = pd.concat([each["map_fits"] for each in made])
    rmse_m = np.median(fits[fits["map"] != "fused"]["rmse_m"])
    landmarks = row(found, "landmark RMSE, m", "")
    assert (landmarks["a"], landmarks["b"]) == pytest.approx((rmse_m, 3 * rmse_m))
    errors = pd.concat([each["errors"] for each in made])
    of_icp = errors[errors["aligner"] == "icp"]
    right = (of_icp["refined_translation_error_m"] <= 0.5).mean()  # of as many answers a map
    assert 0.3 < right < 0.9
    assert row(found, "success refined", "icp")["a"] == pytest.approx(right)


def test_nees_of_fused_pairs_is_per_degree_of_freedom() -> None:
    """Each pair of robots gives the mean over its true pairs, in the plane or in space."""
    rows = {"robot_a": ["A"] * 3 + ["B"] * 2, "robot_b": "C", "run_id": "x"}
    rows |= {"nees_with_drift": [2.0, 4.0, 99.0, 6.0, 3.0], "degrees_of_freedom": [2, 2, 2, 3, 3]}
    fusion = pd.DataFrame(rows | {"true_pair": [True, True, False, True, True]})
    _, _, reduced = READ["fusion"]
    assert reduced(fusion)["nees"].tolist() == [1.5, 1.5]


def test_an_edge_is_false_only_where_it_was_used() -> None:
    _, _, reduced = READ["team_pairs"]
    wrong = {"accepted": True, "n_common": 40, "refined_translation_error_m": 9.0}
    pairs = pd.DataFrame([wrong | {"place": place} for place in ("confirmed", "contradicted")])
    found = reduced(pairs.assign(refined_rotation_error_rad=0.0, team_translation_error_m=1.0))
    assert (found["false"].tolist(), found["found"].tolist()) == ([1.0, 0.0], [0.0, 0.0])
