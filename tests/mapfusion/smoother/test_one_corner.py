"""Tracks against each other: false alarms, corners told apart, their names, what has no track."""

import itertools

import numpy as np
import pytest
from scipy.stats import chi2

from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import rotation
from mapfusion.robot_log import NO_TRACK, Observations, RobotLog
from mapfusion.smoother import smooth
from mapfusion.smoother.problem import order_observations
from mapfusion.smoother.smooth import split_landmarks

STRAY_M, SIGMA_M, N_SEEN = 0.002, 0.001, 4


def seen_tracks(
    rng: np.random.Generator, point_m: Float, path: Float, planar: bool = False
) -> RobotLog:
    """Each point (B, 3) by a track of its own, from `N_SEEN` poses one after the other."""
    n = len(point_m)
    frame = np.sort(np.tile(np.arange(N_SEEN), n))
    track = np.tile(np.arange(n, dtype=np.int32), N_SEEN)
    pose = path[frame]
    at = point_m[track].copy()
    at[:, :2] = np.einsum("nji,nj->ni", rotation(pose[:, 2]), at[:, :2] - pose[:, :2])
    at += SIGMA_M * rng.standard_normal(at.shape)
    at[:, 2] *= not planar
    covariance = np.tile(SIGMA_M**2 * np.eye(3), (len(at), 1, 1))
    observations = Observations(at, covariance, track=track)
    odometry = np.zeros((N_SEEN, 3))
    return RobotLog("R1", planar, np.arange(N_SEEN) * 0.2, odometry, frame, observations)


def path_of(rng: np.random.Generator) -> Float:
    path = rng.uniform(-1, 1, (N_SEEN, 3))
    path[0] = 0
    return path


@pytest.mark.parametrize("planar", [False, True])
def test_two_tracks_of_a_corner_are_parted_as_seldom_as_said(planar: bool) -> None:
    """One pair in a thousand; of 40 000 some 40."""
    rng, n = np.random.default_rng(0), 40_000
    corner = rng.uniform(-3, 3, (n, 3))
    point = np.repeat(corner, 2, axis=0) + STRAY_M * rng.standard_normal((2 * n, 3))
    point[:, 2] *= not planar
    path = path_of(rng)
    log = seen_tracks(rng, point, path, planar)
    landmark = log.observations.track // 2
    made = split_landmarks(
        order_observations(log, landmark, 1, with_offsets=True), landmark, path, STRAY_M
    )
    n_parted = len(np.unique(landmark[made != landmark]))
    expected = 0.001 * n
    assert abs(n_parted - expected) < 4 * np.sqrt(expected)


@pytest.mark.parametrize("by_row", [True, False])
def test_neighbours_are_parted_and_the_one_named_keeps_the_name(by_row: bool) -> None:
    """Three corners in any order, 20 mm apart; the second has most tracks, the third the name."""
    rng, n_landmarks = np.random.default_rng(1), 50
    which = np.array([2, 1, 1, 0, 1, 0])
    corner = rng.uniform(-3, 3, (n_landmarks, 1, 3))
    way = np.zeros((3, 3))
    way[1, 2], way[2, 0] = 0.02, 0.02
    point = (corner + way[which]).reshape(-1, 3)
    point += STRAY_M * np.clip(rng.standard_normal(point.shape), -1.5, 1.5)
    path = path_of(rng)
    log = seen_tracks(rng, point, path)
    own = log.observations.track // len(which)
    row = np.arange(len(own))
    first = np.array([row[own == k].min() for k in range(n_landmarks)])
    # numbered after its first observation, or by what is no observation of its own
    landmark = first[own] if by_row else own + len(own)
    made = split_landmarks(
        order_observations(log, landmark, 1, with_offsets=True), landmark, path, STRAY_M
    )
    is_of = which[log.observations.track % len(which)]
    keeps = 2 if by_row else 1
    np.testing.assert_array_equal(made == landmark, is_of == keeps)
    for k in range(n_landmarks):
        for corner_ in {0, 1, 2} - {keeps}:
            mine = np.flatnonzero((own == k) & (is_of == corner_))
            np.testing.assert_array_equal(made[mine], np.setdiff1d(mine, landmark).min())


def test_a_name_that_is_taken_is_not_given() -> None:
    """The parted corner's first observation is what another landmark is numbered after."""
    rng = np.random.default_rng(4)
    point = np.array([[2.0, 0, 0], [2.0, 0, 0], [2.0, 0, 0.1], [0, 3.0, 0]])
    path = path_of(rng)
    log = seen_tracks(rng, point, path)
    track = log.observations.track
    landmark = np.where(track == 3, 2, 0)  # row 2 is the third track's first
    made = split_landmarks(
        order_observations(log, landmark, 1, with_offsets=True), landmark, path, STRAY_M
    )
    np.testing.assert_array_equal(made, np.array([0, 0, 6, 2])[track])


def test_it_takes_the_corners_that_a_slow_obvious_version_takes() -> None:
    """Tracks strewn so widely that groups overlap."""
    rng, size, n_landmarks = np.random.default_rng(2), 7, 60
    point = np.repeat(rng.uniform(-3, 3, (n_landmarks, 3)), size, axis=0)
    point += 3 * STRAY_M * rng.standard_normal(point.shape)
    path = path_of(rng)
    log = seen_tracks(rng, point, path)
    track, landmark = log.observations.track, log.observations.track // size
    made = split_landmarks(
        order_observations(log, landmark, 1, with_offsets=True), landmark, path, STRAY_M
    )
    pose, told = path[log.iteration], log.observations.position_m.copy()
    told[:, :2] = np.einsum("nij,nj->ni", rotation(pose[:, 2]), told[:, :2]) + pose[:, :2]
    mean = np.stack([told[track == t].mean(axis=0) for t in range(len(point))])
    S = 2 * (SIGMA_M**2 / N_SEEN + STRAY_M**2)
    for k in range(n_landmarks):
        left, groups = set(range(k * size, (k + 1) * size)), []
        while left:
            near = {
                i: [j for j in left if np.sum((mean[i] - mean[j]) ** 2) / S <= chi2.ppf(0.999, 3)]
                for i in sorted(left)
            }
            best = max(near, key=lambda i: len(near[i]))  # the first of the largest
            groups.append(set(near[best]))
            left -= groups[-1]
        found = {}
        for t in range(k * size, (k + 1) * size):
            found.setdefault(int(made[track == t][0]), set()).add(t)
        assert sorted(map(sorted, found.values())) == sorted(map(sorted, groups))


def test_what_has_no_tracks_stays() -> None:
    rng = np.random.default_rng(3)
    path = path_of(rng)
    log = seen_tracks(rng, rng.uniform(-3, 3, (10, 3)), path)
    landmark = np.zeros(len(log.observations), dtype=np.int64)
    for with_offsets in (False, True):
        obs = order_observations(log, landmark, 1, with_offsets=with_offsets)
        made = split_landmarks(obs, landmark, path, STRAY_M)
        assert (len(np.unique(made)) > 1) == with_offsets
    log.observations.track[:] = NO_TRACK
    obs = order_observations(log, landmark, 1, with_offsets=True)
    np.testing.assert_array_equal(split_landmarks(obs, landmark, path, STRAY_M), landmark)


@pytest.mark.parametrize("at_once", [1, 7, 100_000])
def test_pairs_of_tracks_that_are_apart_are_those_of_looking_at_each(
    monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    """However many are looked at together; a landmark's tracks with no other landmark's."""
    monkeypatch.setattr(smooth, "_PAIRS_AT_ONCE", at_once)
    rng = np.random.default_rng(0)
    first = np.array([0, 1, 9, 9, 11, 30])
    point, root = rng.normal(size=(30, 3)), rng.normal(size=(30, 3, 3))
    covariance = root @ np.swapaxes(root, 1, 2)
    covariance[[12, 13]] = 0.0  # of which nothing can be said
    apart = []
    for begin, end in itertools.pairwise(first):
        for i in range(begin, end):
            for j in range(begin, i):
                S, off = covariance[i] + covariance[j], point[i] - point[j]
                known = np.linalg.matrix_rank(S) == 3
                apart += [(i, j)] if known and off @ np.linalg.solve(S, off) > 0.5 else []
    assert 20 < len(apart) < 180
    found = smooth._inconsistent_pairs(first, point, covariance, 0.5)
    np.testing.assert_array_equal(found.T, apart)
