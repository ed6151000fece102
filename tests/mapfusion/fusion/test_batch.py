"""Batch fusion against a solver that knows of no robots, known laws of error, and joint fusion."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from mapfusion.fusion.batch import Batch, JointlySmoothed, smooth_jointly
from mapfusion.fusion.fusers import FusedMap, MergeParameters
from mapfusion.fusion.joint import JointFuser
from mapfusion.fusion.landmark_association import ABSENT
from mapfusion.fusion.merge import connect
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import between, compose, rotation, wrap
from mapfusion.robot_log import NO_TRACK
from tests.mapfusion.fusion.logged_team import STRAY_M, LoggedTeam, labels, log_labels
from tests.mapfusion.smoother.white_noise_logs import NOISE, Known

ROOM = 1.0  # GB, more than any of these takes


def _fused(team: LoggedTeam, *members: int) -> FusedMap:
    fused = Batch().fuse(team.component(*members), MergeParameters())
    assert fused.fallback == ""
    return fused


def _together(team: LoggedTeam) -> JointlySmoothed:
    points = [log_labels(each.log) for each in team.known]
    start = [team.motion(0, k) for k in range(len(points))]
    return smooth_jointly(team.recordings, points, np.array(start), ROOM)


def _n_strays(known: Known) -> int:
    """A track that went into several landmarks is one for each of them."""
    track = known.log.observations.track
    if track is None:
        return 0
    has = track != NO_TRACK
    return len(set(zip(log_labels(known.log)[has], track[has], strict=True)))


class Twin:
    """All poses but the first, all points and all offsets in one dense least-squares problem.

    Weights and the observations' level are those that were found.
    """

    def __init__(self, team: LoggedTeam, found: JointlySmoothed, dimensions: int) -> None:
        self.d, smoothed = dimensions, found.smoothed
        obs, logs = smoothed.obs, [each.log for each in team.known]
        self.obs, self.weights, self.has_offset = obs, smoothed.weights, obs.has_offset
        position = np.concatenate([log.observations.position_m for log in logs])[obs.row]
        covariance = np.concatenate([log.observations.covariance_m2 for log in logs])[obs.row]
        self.position = position[:, : self.d]
        level = np.where(self.has_offset[obs.track], smoothed.observation_scale, 1.0)
        scaled = (level / self.weights.observation)[:, None, None] * covariance
        self.root = np.linalg.inv(np.linalg.cholesky(scaled[:, : self.d, : self.d]))
        self.ends = np.cumsum([len(log) for log in logs])
        self.odometry, self.levels = [log.odometry for log in logs], smoothed.odometry_scales
        at = smoothed.estimate
        self.n = 3 * (len(at.path) - 1), self.d * len(at.point_m)
        parts = at.path[1:], at.point_m[:, : self.d], at.offset_m[self.has_offset, : self.d]
        self.found = np.concatenate([part.ravel() for part in parts])

    def residuals(self, x: Float) -> Float:
        n, m = self.n
        path = np.concatenate([np.zeros((1, 3)), x[:n].reshape(-1, 3)])
        points, offsets = x[n : n + m].reshape(-1, self.d), np.zeros((len(self.has_offset), self.d))
        offsets[self.has_offset] = x[n + m :].reshape(-1, self.d)
        pose, at = path[self.obs.frame], points[self.obs.landmark] + offsets[self.obs.track]
        at[:, :2] = np.einsum("nji,nj->ni", rotation(pose[:, 2]), at[:, :2] - pose[:, :2])
        parts = [np.einsum("nij,nj->ni", self.root, at - self.position)]
        parts.append((offsets * np.sqrt(self.weights.offset)[:, None] / STRAY_M)[self.has_offset])
        for odometry, way in zip(self.odometry, np.split(path, self.ends[:-1]), strict=True):
            d = between(way[:-1], way[1:]) - odometry[1:]
            d[:, 2] = wrap(d[:, 2])
            sigma = np.array([NOISE.standard_deviations(each) for each in odometry[1:]])
            still = np.array([1e-8, 1e-8, 1e-10])
            parts.append(d / np.sqrt(np.maximum(self.levels * (sigma**2 + still), still)))
        return np.concatenate([part.ravel() for part in parts])


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize(("n_frames", "tracks"), [(16, True), (40, False)])
def test_equals_a_dense_solver_that_knows_of_no_robots(
    planar: bool, n_frames: int, tracks: bool
) -> None:
    """Few poses among many points, and many among few: either is eliminated first."""
    team = LoggedTeam(1, 2, n_frames, 14, planar, tracks)
    found, d = _together(team), 2 + (not planar)
    assert np.count_nonzero(found.smoothed.obs.has_offset) == sum(map(_n_strays, team.known))
    twin = Twin(team, found, d)
    solved = least_squares(twin.residuals, twin.found, xtol=1e-14, ftol=1e-14, gtol=1e-12)
    covariance = np.linalg.inv(solved.jac.T @ solved.jac)
    sigma = np.sqrt(np.diag(covariance))
    off = np.abs(solved.x - twin.found) / sigma
    assert off[: twin.n[0]].max() < 0.05
    assert off.max() < 0.2  # single tracks may still go on when poses have stopped
    first = slice(3 * n_frames - 3, 3 * n_frames)  # pose of the second robot, where it began
    off = found.motion_covariance[1] - covariance[first, first]
    assert np.abs(off / np.outer(sigma[first], sigma[first])).max() < 5e-3
    of_points = slice(twin.n[0], sum(twin.n))
    n = len(found.points)
    joint = found.smoothed.joint_covariance().reshape(n, 3, n, 3)[:, :d, :, :d]
    off = joint.reshape(d * n, d * n) - covariance[of_points, of_points]
    assert np.abs(off / np.outer(sigma[of_points], sigma[of_points])).max() < 5e-3


@pytest.mark.parametrize("members", [(0, 1, 2), (1, 2)])
def test_paths_are_the_members_in_the_fused_frame(members: tuple[int, ...]) -> None:
    team = LoggedTeam(3, 3, 30, 40)
    fused = Batch().fuse(team.component(*members), MergeParameters())
    assert len(fused.paths) == len(members)
    np.testing.assert_array_equal(fused.paths[0][0], 0.0)
    for k, path in zip(members, fused.paths, strict=True):
        np.testing.assert_array_equal(path[0], fused.T_first_map[k])
        truth = compose(team.motion(members[0], k), team.known[k].path)
        off = path - truth
        assert path.shape == truth.shape
        assert np.hypot(off[:, 0], off[:, 1]).max() < 0.1  # the robots drive metres apart
    assert JointFuser().fuse(team.component(*members), MergeParameters()).paths == ()


@pytest.mark.parametrize("planar", [False, True])
def test_errors_obey_the_covariances(planar: bool) -> None:
    """Errors of motions and landmarks obey them; joint fusion states nearly the same."""
    seeds, d = range(20), 2 + (not planar)
    total, dof, motions, apart, larger = 0.0, 0, [], [], []
    for seed in seeds:
        team = LoggedTeam(seed, 2, 40, 30, planar, tracks=not planar)
        component = team.component(0, 1)
        fused = Batch().fuse(component, MergeParameters())
        e, kept = team.errors(fused)[:, :d].ravel(), np.arange(3 * len(fused.landmarks)) % 3 < d
        joint = fused.landmarks.joint
        assert joint is not None
        total += e @ np.linalg.solve(joint.dense_m2()[np.ix_(kept, kept)], e)
        dof += len(e)
        off = team.motion_error(fused, 1)
        motions.append(off @ np.linalg.solve(fused.motion_covariance[1], off))
        by_maps = JointFuser().fuse(component, MergeParameters())
        np.testing.assert_array_equal(by_maps.parents, fused.parents)
        sigma_m2 = np.trace(fused.landmarks.covariance_m2, axis1=1, axis2=2)
        off_m = by_maps.landmarks.position_m - fused.landmarks.position_m
        apart.append(np.mean(np.sum(off_m**2, axis=1) / sigma_m2))
        its_m2 = np.trace(by_maps.landmarks.covariance_m2, axis1=1, axis2=2)
        larger.append(np.mean(its_m2 / sigma_m2))
    low, high = chi2.ppf([0.001, 0.999], dof) / dof
    assert low < total / dof < high
    low, high = chi2.ppf([0.001, 0.999], 3 * len(seeds))
    assert low < np.sum(motions) < high
    assert np.sqrt(np.mean(apart)) < 0.2  # each map's levels are those of its own log
    assert 0.95 < np.mean(larger) < 1.05


def test_one_log_alone_gives_its_own_map() -> None:
    team = LoggedTeam(3, 1, tracks=True)
    fused, own = _fused(team, 0), team.maps[0]
    order = fused.parents[:, 0]
    sigma_m = np.sqrt(np.trace(own.covariance_m2[order], axis1=1, axis2=2))
    off_m = np.linalg.norm(fused.landmarks.position_m - own.position_m[order], axis=1)
    assert np.max(off_m / sigma_m) < 0.1  # either stops short of the same place
    np.testing.assert_allclose(
        fused.landmarks.covariance_m2, own.covariance_m2[order], rtol=0.02, atol=1e-6
    )
    np.testing.assert_array_equal(fused.motion_covariance, np.zeros((1, 3, 3)))


def test_the_frame_is_the_first_member_s_and_maps_left_out_have_no_part() -> None:
    team = LoggedTeam(4, 3)
    fused = _fused(team, 1, 2)
    np.testing.assert_array_equal(fused.members, [1, 2])
    np.testing.assert_array_equal(fused.T_first_map[1], 0.0)
    assert np.all(fused.parents[:, 0] == ABSENT)
    off = team.motion_error(fused, 2)
    assert off @ np.linalg.solve(fused.motion_covariance[2], off) < chi2.ppf(0.999, 3)
    own = fused.parents[:, 2] != ABSENT
    np.testing.assert_array_equal(
        labels(fused.landmarks)[own], labels(team.maps[2])[fused.parents[own, 2]]
    )


def test_connected_maps_hand_on_what_they_were_smoothed_from() -> None:
    team = LoggedTeam(4)
    connected = connect(team.maps, team.component(0, 1).pairs)
    for recordings, fallback in ((team.recordings, False), ((), True)):
        fused = connected.fused_by(Batch(), MergeParameters(), recordings).fused[0]
        np.testing.assert_array_equal(fused.members, [0, 1])
        assert bool(fused.fallback) == fallback


def test_what_hinders_it_is_said_and_joint_fusion_takes_its_place() -> None:
    team = LoggedTeam(5)
    component = team.component(0, 1)
    one, other = team.recordings
    other_offset = replace(other, parameters=replace(other.parameters, stray_m=0.1))
    for fuser, recordings, said in (
        (Batch(), (), "the log of R1's smoothed map is not known"),
        (Batch(), (one, None), "the log of R1's smoothed map is not known"),
        (Batch(), (one, other_offset), "the logs have different values of stray_m"),
        (Batch(1e-6), (one, other), "smoothing all logs at once: may take "),
    ):
        given = replace(component, recordings=recordings)
        fused = fuser.fuse(given, MergeParameters())
        joint = JointFuser().fuse(given, MergeParameters())
        assert fused.fallback.startswith(said)
        np.testing.assert_array_equal(fused.landmarks.position_m, joint.landmarks.position_m)
