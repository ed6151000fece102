import numpy as np
import pandas as pd
import pytest
from evo.core import metrics
from evo.core.trajectory import PosePath3D

from experiments.evaluation.path_errors import (
    SOURCES,
    STATISTICS,
    ate_m,
    pairs_by_frames,
    pairs_by_length,
    path_rms,
    path_statistics_rows,
    rpe,
    seven_statistics,
)
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float


def wander(rng: np.random.Generator, n: int) -> tuple[Float, Float]:
    """A true path (n, 3) and an estimate of it in another frame, with drift and noise."""
    steps = np.column_stack(
        [rng.uniform(0, 0.2, n), rng.normal(0, 0.02, n), rng.normal(0, 0.15, n)]
    )
    truth, path = np.zeros((n, 3)), np.zeros((n, 3))
    for i in range(1, n):
        truth[i] = se2.compose(truth[i - 1], steps[i])
        path[i] = se2.compose(path[i - 1], steps[i] + rng.normal(0, [0.02, 0.02, 0.01]))
    return truth, se2.compose(rng.normal(0, 3, 3), path)


def evo_path(poses: Float) -> PosePath3D:
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    for matrix, pose in zip(matrices, poses, strict=True):
        matrix[:2, :2], matrix[:2, 3] = se2.rotation(pose[2]), pose[:2]
    return PosePath3D(poses_se3=list(matrices))


def evo_rpe(path: Float, truth: Float, relation: metrics.PoseRelation, delta, unit) -> dict:
    measured = metrics.RPE(relation, delta, unit, pairs_from_reference=True)
    measured.process_data((evo_path(truth), evo_path(path)))
    return measured.get_all_statistics()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("fit", [False, True])
def test_ate_equals_evos(fit: bool, seed: int) -> None:
    truth, path = wander(np.random.default_rng(seed), 180)
    reference, estimate = evo_path(truth), evo_path(path)
    if fit:
        estimate.align(reference, correct_scale=False)
    measured = metrics.APE(metrics.PoseRelation.translation_part)
    measured.process_data((reference, estimate))
    ours = seven_statistics(ate_m(path, truth, fit))
    assert set(ours) == set(STATISTICS)
    assert ours == pytest.approx(measured.get_all_statistics(), rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("delta", "unit"), [(1, "frames"), (7, "frames"), (1.0, "m"), (2.5, "m")])
def test_rpe_equals_evos(delta: float, unit: str, seed: int) -> None:
    truth, path = wander(np.random.default_rng(10 + seed), 180)
    if unit == "frames":
        pairs, evo_unit = pairs_by_frames(np.ones(180, bool), int(delta)), metrics.Unit.frames
    else:
        pairs, evo_unit = pairs_by_length(truth[:, :2], delta), metrics.Unit.meters
    length_m, angle_rad = rpe(path, truth, pairs)
    for errors, relation in (
        (length_m, metrics.PoseRelation.translation_part),
        (angle_rad, metrics.PoseRelation.rotation_angle_rad),
    ):
        expected = evo_rpe(path, truth, relation, delta, evo_unit)
        assert seven_statistics(errors) == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_a_path_moved_as_a_whole_has_no_error_but_from_its_start() -> None:
    truth, _ = wander(np.random.default_rng(1), 50)
    moved = se2.compose(np.array([3.0, 4.0, 0.0]), truth)
    np.testing.assert_allclose(ate_m(moved, truth), 0, atol=1e-9)
    np.testing.assert_allclose(ate_m(moved, truth, fit=False), 5, atol=1e-9)


def test_frames_without_truth_are_left_out() -> None:
    known = np.array([1, 1, 0, 1, 1, 1, 1], bool)
    assert pairs_by_frames(known, 1).tolist() == [[0, 1], [2, 3], [3, 4], [4, 5]]
    assert pairs_by_frames(known, 2).tolist() == [[3, 5]]  # frames 4 and 6
    assert pairs_by_frames(known, 9).tolist() == []


def paths_table(truth: Float, path: Float) -> pd.DataFrame:
    columns = {"robot": "R1", "iteration": np.arange(len(path))}
    for source, poses in (("final", path), ("online", path), ("odometry", path), ("truth", truth)):
        columns |= {f"{source}_{n}": poses[:, i] for i, n in enumerate(("x_m", "y_m", "theta_rad"))}
    return pd.DataFrame(columns)


def test_table_has_each_source_and_quantity_and_lives_with_gaps() -> None:
    truth, path = wander(np.random.default_rng(2), 120)
    truth[40:55] = np.nan
    rows = pd.DataFrame(path_statistics_rows(paths_table(truth, path)))
    assert len(rows) == 3 * 6
    ate = rows[(rows["source"] == "final") & (rows["quantity"] == "ate_m")].iloc[0]
    known = np.isfinite(truth[:, 0])
    assert ate["n"] == 105
    assert ate["rmse"] == np.sqrt(np.mean(ate_m(path[known], truth[known]) ** 2))
    frames = rows[(rows["quantity"] == "rpe_m") & (rows["delta_unit"] == "frames")]
    assert (frames["n"] == 40 - 1 + 65 - 1).all()


@pytest.mark.parametrize("known", [0, 1, 2])
def test_hardly_any_truth(known: int) -> None:
    truth, path = wander(np.random.default_rng(3), 5)
    truth[known:] = np.nan
    rows = pd.DataFrame(path_statistics_rows(paths_table(truth, path)))
    assert (rows[rows["quantity"] == "ate_m"]["n"] == known).all()
    assert rows[rows["delta_unit"] == "m"]["rmse"].isna().all()


def test_rms_over_a_run_is_of_what_is_known() -> None:
    rows = [("A", 3.0, 6.0), ("A", 4.0, 8.0), ("B", 2.0, 0.0), ("B", np.nan, 0.0)]
    robots = pd.DataFrame(rows, columns=["robot", "path_error_m", "odometry_error_m"])
    found = path_rms(robots.assign(n_landmarks=[1, 5, 2, 7])).set_index("robot")
    assert found["path_m"].tolist() == [np.sqrt(12.5), 2.0]
    assert found["odometry_m"].tolist() == [np.sqrt(50), 0.0]
    assert found.loc["A", "over_odometry"] == pytest.approx(0.5)
    assert np.isnan(found.loc["B", "over_odometry"])
    assert found[["n_landmarks", "n_frames"]].to_numpy().tolist() == [[5, 2], [7, 2]]


def test_a_smoothed_path_is_a_source_where_there_is_one() -> None:
    truth, path = wander(np.random.default_rng(4), 40)
    with_one = paths_table(truth, path)
    for name in ("x_m", "y_m", "theta_rad"):
        with_one[f"smoothed_{name}"] = with_one[f"truth_{name}"]
    rows = pd.DataFrame(path_statistics_rows(with_one))
    assert rows.loc[rows["source"] == "smoothed", "rmse"].to_numpy() == pytest.approx(0, abs=1e-9)
    without = with_one.assign(smoothed_x_m=np.nan, smoothed_y_m=np.nan, smoothed_theta_rad=np.nan)
    assert set(pd.DataFrame(path_statistics_rows(without))["source"]) == {*SOURCES} - {"smoothed"}


def test_a_way_of_just_the_length_is_long_enough() -> None:
    """Steps of a quarter of a metre add up exactly: four of them are one metre."""
    positions = np.column_stack([0.25 * np.arange(10), np.zeros(10)])
    assert pairs_by_length(positions, 1.0).tolist() == [[0, 4], [4, 8]]
