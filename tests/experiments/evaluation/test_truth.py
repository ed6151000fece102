from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.evaluation.truth import (
    PathTruth,
    common_landmarks,
    fit_rmse_m,
    is_surveyed,
    landmark_truth,
    true_pairs,
    truth_or_unknown,
)
from experiments.pipeline.stages.slam import Associations
from mapfusion.errors import InputError
from mapfusion.geometry import se2
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import (
    Observations,
    RobotLog,
    RobotTruth,
    write_truth_points,
    write_truth_poses,
)
from tests.helpers.made_up_maps import landmark_map


def changes_of(snapshots: dict[int, np.ndarray]) -> Associations:
    """Only what changed from one snapshot (N,) of owners to the next, as the SLAM stage writes."""
    rows, known = [], {}
    for iteration, owner in snapshots.items():
        for observation, source in enumerate(owner.tolist()):
            if known.get(observation, -1) != source:
                rows.append((iteration, observation, source))
                known[observation] = source
    return Associations(*np.array(rows, dtype=np.int64).reshape(-1, 3).T)


def map_of(owner: np.ndarray) -> LandmarkMap:
    sources = np.unique(owner[owner >= 0])
    landmarks = landmark_map(np.zeros((len(sources), 3)))
    return LandmarkMap(
        landmarks.position_m, landmarks.covariance_m2, landmarks.count, sources.astype(np.int64)
    )


@pytest.mark.parametrize("with_maps", [(10, 20, 30, 45), (20, 45)])
def test_landmark_truth_follows_changing_associations(with_maps: tuple[int, ...]) -> None:
    """Against the median over the whole list of owners, taken anew at each iteration."""
    rng = np.random.default_rng(4)
    n = 60
    points = rng.normal(size=(n, 3))
    points[rng.random(n) < 0.2] = np.nan
    snapshots, owner = {}, np.empty(0, dtype=np.int64)
    for iteration in (10, 20, 30, 45):
        owner = np.concatenate([owner, np.full(15, -1)])
        moved = rng.random(len(owner)) < 0.5  # another particle became the best one
        owner[moved] = rng.integers(-1, 8, moved.sum())
        snapshots[iteration] = owner.copy()
    maps = {iteration: map_of(snapshots[iteration]) for iteration in with_maps}
    found = landmark_truth(RobotTruth(np.zeros((50, 3)), points), changes_of(snapshots).at, maps)
    for iteration in with_maps:
        owners = snapshots[iteration]
        for source, point in zip(maps[iteration].source_observation, found[iteration], strict=True):
            seen = [points[i] for i in range(len(owners)) if owners[i] == source]
            seen = [p for p in seen if np.isfinite(p).all()]
            expected = np.median(seen, axis=0) if seen else np.full(3, np.nan)
            np.testing.assert_array_equal(point, expected)


def test_landmark_truth_forgets_an_observation_that_went_elsewhere() -> None:
    """To no landmark at all: none gains one."""
    points = np.array([[0.0, 0, 0], [1, 2, 3], [8, 9, 7]])
    owners = {10: np.array([0, 0, 0]), 20: np.array([0, 0, -1]), 30: np.array([-1, -1, -1])}
    maps = dict.fromkeys(owners, map_of(owners[10]))
    truth = RobotTruth(np.zeros((40, 3)), points)
    found = landmark_truth(truth, changes_of(owners).at, maps)
    np.testing.assert_array_equal(found[10], [[1, 2, 3]])
    np.testing.assert_array_equal(found[20], [[0.5, 1, 1.5]])
    np.testing.assert_array_equal(found[30], [[np.nan] * 3])


def test_landmark_truth_of_more_landmarks_than_16_bits_count() -> None:
    n = 2**16 + 100
    points = np.random.default_rng(0).normal(size=(n, 3))
    owner = np.arange(n)
    owner[1::2] -= 1  # two observations each, but for the last hundred
    owner[-100:] = np.arange(n - 100, n)
    alone = map_of(np.arange(n))
    truth = RobotTruth(np.zeros((1, 3)), points)
    each = landmark_truth(truth, lambda iteration, count: np.arange(n)[:count], {0: alone})
    np.testing.assert_array_equal(each[0], points)
    both = landmark_truth(truth, lambda iteration, count: owner[:count], {0: map_of(owner)})
    middle = (points[:-100:2] + points[1:-100:2]) / 2
    np.testing.assert_array_equal(both[0], np.concatenate([middle, points[-100:]]))


def test_landmark_truth_of_an_empty_map() -> None:
    truth = RobotTruth(np.zeros((5, 3)), np.zeros((0, 3)))
    nothing = changes_of({})
    found = landmark_truth(truth, nothing.at, {3: landmark_map(np.zeros((0, 3)))})
    assert found[3].shape == (0, 3)


def test_true_pairs_need_known_points_within_the_radius() -> None:
    a = np.array([[0.0, 0, 0], [1, 0, 0], [np.nan, 0, 0]])
    b = np.array([[0.0, 0.09, 0], [1, 0.11, 0], [0, 0, 0.2]])
    index = np.array([0, 1, 2, 0])
    pairs = true_pairs(a, b, index, np.array([0, 1, 0, 2]), 0.10)
    assert pairs.tolist() == [True, False, False, False]


@given(st.integers(0, 12), st.integers(0, 12), st.integers(0, 10**6))
def test_common_landmarks_is_the_count_of_mutual_nearest(n_a: int, n_b: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(0, 1, (n_a, 3)), rng.uniform(0, 1, (n_b, 3))
    a[rng.random(n_a) < 0.2] = np.nan
    radius = 0.4
    expected = 0
    for i in range(n_a):
        for j in range(n_b):
            distance = np.linalg.norm(a[i] - b[j])
            nearest_b = all(not np.linalg.norm(a[i] - other) < distance for other in b)
            nearest_a = all(not np.linalg.norm(other - b[j]) < distance for other in a)
            expected += bool(distance <= radius and nearest_a and nearest_b)
    assert common_landmarks(a, b, radius) == expected


def test_fit_leaves_noise_alone() -> None:
    """A moved map fits exactly; noise of sigma per axis leaves sigma sqrt(3), less 3 parameters."""
    rng = np.random.default_rng(2)
    points = rng.uniform(-5, 5, (4000, 3))
    T_map_world = np.array([3.0, -2.0, 2.5])
    moved = se2.transform_points(T_map_world, points)
    points_known = points.copy()
    points_known[::2] = np.nan
    n, rmse_m = fit_rmse_m(moved, points_known)
    assert n == 2000
    assert rmse_m == pytest.approx(0, abs=1e-12)
    _, rmse_m = fit_rmse_m(moved + rng.normal(0, 0.1, points.shape), points)
    assert rmse_m == pytest.approx(0.1 * np.sqrt(3), rel=0.03)
    # heights are part of it, though no motion in the plane can mend them
    _, rmse_m = fit_rmse_m(moved + np.array([0, 0, 0.5]), points)
    assert rmse_m == pytest.approx(0.5)


def test_fit_by_hand() -> None:
    """A segment of 2 m mapped as one of 4 m: each end is left 1 m off."""
    n, rmse_m = fit_rmse_m(
        np.array([[-2.0, 0, 0], [2, 0, 0]]), np.array([[5.0, 1, 0], [5.0, 3, 0]])
    )
    assert n == 2
    assert rmse_m == pytest.approx(1)


@pytest.mark.parametrize("known", [0, 1])
def test_fit_needs_two_known_points(known: int) -> None:
    points = np.full((5, 3), np.nan)
    points[:known] = 0
    n, rmse_m = fit_rmse_m(np.zeros((5, 3)), points)
    assert n == known
    assert np.isnan(rmse_m)


def test_path_starts_at_the_first_known_pose() -> None:
    poses = np.array([[np.nan] * 3, [1, 2, np.pi / 2], [1, 3, np.pi / 2], [0, 3, np.pi]])
    path = PathTruth.of(RobotTruth(poses, np.zeros((0, 3))))
    np.testing.assert_array_equal(path.T_world_map, poses[1])
    expected = [[0, 0, 0], [1, 0, 0], [1, 1, np.pi / 2]]  # forward is x, left is y
    np.testing.assert_allclose(path.T_map_robot[1:], expected, atol=1e-12)
    assert np.isnan(path.T_map_robot[0]).all()


def two_frames() -> tuple[RobotLog, np.ndarray, np.ndarray]:
    """Return a log without noise, its true poses, and the true points of its observations."""
    rng = np.random.default_rng(2)
    poses = np.array([[1.0, -2.0, 0.3], [1.5, -1.0, 2.0], [4.0, 0.0, -1.0]])
    iteration, points = np.array([0, 0, 1, 2]), rng.normal(size=(4, 3))
    # in the complex plane: local = (world - position) exp(-i heading)
    ahead = np.exp(-1j * poses[iteration, 2])
    local = (points[:, :2] - poses[iteration, :2]) @ [1, 1j] * ahead
    position = np.column_stack([local.real, local.imag, points[:, 2]])
    seen = Observations(position, np.tile(np.eye(3), (4, 1, 1)))
    log = RobotLog("R1", False, np.arange(3.0), np.zeros((3, 3)), iteration, seen)
    return log, poses, points


def test_true_poses_place_the_observations(tmp_path: Path) -> None:
    log, poses, points = two_frames()
    poses[1] = np.nan
    write_truth_poses(tmp_path, poses)
    truth = truth_or_unknown(tmp_path, log)
    np.testing.assert_array_equal(truth.T_world_robot, poses)
    np.testing.assert_allclose(truth.point_world_m[[0, 1, 3]], points[[0, 1, 3]], atol=1e-12)
    assert np.isnan(truth.point_world_m[2]).all()
    assert not is_surveyed(tmp_path)


def test_true_points_alone_leave_the_poses_unknown(tmp_path: Path) -> None:
    log, _, points = two_frames()
    nothing = truth_or_unknown(tmp_path, log)
    assert np.isnan(nothing.T_world_robot).all()
    assert np.isnan(nothing.point_world_m).all()
    write_truth_points(tmp_path, points)
    truth = truth_or_unknown(tmp_path, log)
    assert np.isnan(truth.T_world_robot).all()
    np.testing.assert_array_equal(truth.point_world_m, points)
    assert is_surveyed(tmp_path)
    write_truth_points(tmp_path, points[:2])
    with pytest.raises(InputError, match=r"truth_points\.parquet: 2 rows, the log has 4"):
        truth_or_unknown(tmp_path, log)


def test_the_origin_of_a_map_is_fitted_to_true_points() -> None:
    rng = np.random.default_rng(3)
    T_world_map = np.array([3.0, -1.0, 0.7])
    own = rng.normal(size=(12, 3))
    maps = {4: landmark_map(own[:5]), 9: landmark_map(own)}
    points = {k: se2.transform_points(T_world_map, each.position_m) for k, each in maps.items()}
    points[9][:3] = np.nan
    unknown = PathTruth.of(RobotTruth(np.full((3, 3), np.nan), np.empty((0, 3))))
    found = unknown.or_fitted(maps, points)
    assert found.fitted
    np.testing.assert_allclose(found.T_world_map, T_world_map, atol=1e-12)
    known = PathTruth.of(RobotTruth(np.zeros((3, 3)), np.empty((0, 3))))
    assert known.or_fitted(maps, points) is known
