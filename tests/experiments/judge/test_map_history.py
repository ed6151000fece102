"""The kept history against the tables that hold the same at the end, and on failed alignments."""

from pathlib import Path

import numpy as np
import pandas as pd

from experiments.evaluation import tables
from experiments.pipeline.tables import unpacked
from mapfusion.geometry import se2

PLAN = ["x_m", "y_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2"]


def read(result: Path, name: str) -> pd.DataFrame:
    return tables.read(tables.table_path(result, name), name)


def test_the_last_maps_are_the_landmarks(tiny_result: Path) -> None:
    history, landmarks = read(tiny_result, "map_history"), read(tiny_result, "landmarks")
    assert sorted(history["iteration"].unique()) == [10, 20, 30, 40, 43]
    last = history[history["iteration"] == 43].merge(landmarks, on=["robot", "landmark"])
    assert len(last) == len(landmarks)
    for name in PLAN:
        single = last[f"{name}_y"].to_numpy().astype(np.float32)
        np.testing.assert_array_equal(last[f"{name}_x"].to_numpy(), single)


def test_the_true_pairs_are_as_many_as_the_evaluation_counted(tiny_result: Path) -> None:
    key = ["robot_a", "robot_b", "iteration"]
    errors = read(tiny_result, "errors").groupby(key)[["n_true", "n_correspondences"]].first()
    judged = read(tiny_result, "true_pairs").set_index(key)
    assert len(judged) == len(errors)
    for index, row in judged.iterrows():
        bits = unpacked(row["true_pair"], row["n_correspondences"])
        assert bits.sum() == errors.loc[index, "n_true"]
        assert row["n_correspondences"] == errors.loc[index, "n_correspondences"]


def test_what_inliers_fuse_to_is_in_the_fused_map(tiny_result: Path) -> None:
    """The merge at the end joins these, and with its second pass some more."""
    history, fused = read(tiny_result, "fused_history"), read(tiny_result, "fused")
    last = history[history["iteration"] == 43]
    both = fused[fused["n_parents"] == 2]
    joined = last.merge(both, on=["landmark_a", "landmark_b"])
    assert 0 < len(joined) == len(last) <= len(both)
    np.testing.assert_allclose(joined["x_m_x"], joined["x_m_y"], atol=1e-5)
    np.testing.assert_allclose(joined["cov_yy_m2_x"], joined["cov_yy_m2_y"], rtol=1e-5)


def test_only_accepted_alignments_fuse(tiny_result: Path) -> None:
    estimates = read(tiny_result, "estimates")
    merged = estimates[(estimates["aligner"] == "ransac") & (estimates["repetition"] == 0)]
    accepted = merged[merged["refined_status"] == "accepted"]["iteration"]
    assert set(read(tiny_result, "fused_history")["iteration"]) <= set(accepted)


def test_the_fused_motions_are_those_that_moved_the_landmarks(tiny_result: Path) -> None:
    """A landmark that one robot alone saw lies in the fused map where its motion puts it."""
    fused, landmarks = read(tiny_result, "fused"), read(tiny_result, "landmarks")
    carried = fused[fused["n_parents"] == 1].merge(
        landmarks, left_on=["robot_a", "landmark_a"], right_on=["robot", "landmark"]
    )
    for row in read(tiny_result, "fused_motions").to_dict("records"):
        own = carried[carried["robot"] == row["robot"]]
        T_first_robot = np.array([row["tx_m"], row["ty_m"], row["theta_rad"]])
        moved = se2.transform_points(T_first_robot, own[["x_m_y", "y_m_y", "z_m_y"]].to_numpy())
        np.testing.assert_allclose(moved, own[["x_m_x", "y_m_x", "z_m_x"]], atol=1e-9)
        assert (row["left_out"] == "") == bool(len(own))
        added = [
            own[[f"cov_xx_m2_{side}", f"cov_yy_m2_{side}"]].to_numpy().sum() for side in "xy"
        ]  # a turn changes no trace
        expected = 2 * len(own) * row["drift_sigma_m"] ** 2
        np.testing.assert_allclose(added[0] - added[1], expected, atol=1e-9)
