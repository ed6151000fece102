"""Tests of `mapfusion.fastslam.loop_closing`."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.fastslam.filter import FastSlam
from mapfusion.fastslam.landmark_arrays import slots_near
from mapfusion.fastslam.loop_closing import (
    KNOT_SPACING,
    DriftModel,
    FrameAssociation,
    close_loops,
    odometry_noise_factor,
)
from mapfusion.fastslam.measurement import DROPPED, NEW, observations_in_map
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.fastslam.particles import ParticleMaps, PathHistory
from mapfusion.fastslam.resampling import MEMORY
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import between, compose, inverse, rotation_about_z, transform_points
from mapfusion.robot_log import Observations
from tests.mapfusion.fastslam.landmark_worlds import drive, nothing, parameters

SURE = 1 - 1e-12  # every closure is believed
FAR = np.array([1e3, 1e3])  # where the least turn moves a robot by a millimetre


def spread_matrix(rng: np.random.Generator, size: float) -> Float:
    root = size * rng.standard_normal((3, 3))
    return root @ root.T


class AnyFrames:
    """Dense Gaussian of the drift at some frames, in ascending order."""

    def __init__(self, steps: Float, frames: np.ndarray) -> None:
        walk, n = np.cumsum(steps, axis=0)[frames], len(frames)
        earlier = np.minimum(*np.indices((n, n)))
        self.covariance = walk[earlier].transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)
        self.frames, self.mean = frames, np.zeros(3 * n)

    def add_closure(self, now: int, then: int, motion: Float, noise: Float) -> None:
        """Update with an observed difference of the drift between two frames."""
        slope = np.zeros((len(self.frames), 3, 3))
        slope[self.frames == now], slope[self.frames == then] = np.eye(3), -np.eye(3)
        slope = slope.transpose(1, 0, 2).reshape(3, -1)
        gain = self.covariance @ slope.T @ np.linalg.inv(slope @ self.covariance @ slope.T + noise)
        self.mean = self.mean + gain @ (motion - slope @ self.mean)
        self.covariance = self.covariance - gain @ slope @ self.covariance


@pytest.mark.parametrize("taken", [False, True])
@pytest.mark.parametrize("n_spacings", [7, 70])  # the latter more than there are knots
def test_loops_one_inside_the_other_bend_the_path_as_dense_algebra_has_it(n_spacings, taken):
    rng = np.random.default_rng(n_spacings)
    n = n_spacings * KNOT_SPACING
    steps = np.array([spread_matrix(rng, 1e-2) for _ in range(n)])
    steps[0] = 0  # before the first frame there is no path
    knots = np.arange(
        4 * KNOT_SPACING, n - KNOT_SPACING, 4 * KNOT_SPACING
    )  # of those that are kept to the end
    loops = {
        4 * KNOT_SPACING + 3: 0,
        6 * KNOT_SPACING + 7: 2 * KNOT_SPACING,
        n - 1: 4 * KNOT_SPACING,
    }
    frames = np.unique([0, 2 * KNOT_SPACING, *knots, *loops])
    drift_model, dense, total = DriftModel(), AnyFrames(steps, frames), np.zeros((n, 3))
    for frame, step in enumerate(steps):
        drift_model.add_frame(step)
        if frame not in loops:
            continue
        then, motion = loops[frame], rng.normal(0, 0.05, 3)
        noise, now = spread_matrix(rng, 0.02), spread_matrix(rng, 0.01)
        dense.add_closure(frame, then, motion, noise + now)
        # the map shows no more what it was bent by before
        seen = motion - total[frame] + total[then]
        information = np.linalg.inv(noise)
        drift_model.add_closure(
            np.array([then]), information[None], (information @ seen)[None], now, SURE
        )
        if taken or frame == n - 1:
            found = drift_model.take_correction(FAR)
            assert found is not None
            total[: frame + 1] += drift_model.interpolate(found, np.arange(frame + 1))
            total[frame + 1 :] = total[frame]
    checked = frames[(frames >= 4 * KNOT_SPACING) & np.isin(frames, [*knots, n - 1])]
    expected = dense.mean.reshape(-1, 3)[np.isin(frames, checked)]
    np.testing.assert_allclose(total[checked], expected, atol=1e-9)
    assert np.abs(total[n - 1]).max() > 1e-3


def test_between_two_knots_a_bend_grows_evenly():
    drift_model = DriftModel()
    for _ in range(3 * KNOT_SPACING):
        drift_model.add_frame(1e-4 * np.eye(3))
    given = np.array([[0, 0, 0], [0, 0, 0], [0.4, 0, 0.2], [0.4, 0, 0.2]])
    frame = np.array([KNOT_SPACING, KNOT_SPACING + KNOT_SPACING // 2, 2 * KNOT_SPACING])
    expected = [[0, 0, 0], [0.2, 0, 0.1], [0.4, 0, 0.2]]
    np.testing.assert_allclose(drift_model.interpolate(given, frame), expected, atol=1e-12)


def test_one_landmark_says_nothing_of_the_turn_about_it():
    """Seen off by 0.1 m in x at (2, 3), where the path may have turned about the origin alone."""
    drift_model = DriftModel()
    for _ in range(2 * KNOT_SPACING):
        drift_model.add_frame(np.diag([0, 0, 1e-3]))
    slope = np.array([[1.0, 0, -3], [0, 1, 2]])
    information = 1e4 * slope.T @ slope
    pull = 1e4 * slope.T @ [0.1, 0.0]
    drift_model.add_closure(np.array([0]), information[None], pull[None], np.zeros((3, 3)), SURE)
    # a turn t is seen as (-3 t, 2 t): least squares with its prior
    turn = 1e4 * -0.3 / (1e4 * 13 + 1 / (2 * KNOT_SPACING * 1e-3))
    found = drift_model.take_correction(np.zeros(2) + 10)
    assert found is not None
    np.testing.assert_allclose(found[-1], [0, 0, turn], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("sigmas", "believed"), [(3.9, True), (5.0, False)])
def test_a_closure_that_no_drift_explains_is_not_believed(sigmas, believed):
    """The 0.9999 quantile of chi-square with 3 degrees of freedom is 21.1, 4.6 squared."""
    drift_model, sigma_m = DriftModel(), 0.03
    for _ in range(2 * KNOT_SPACING):
        drift_model.add_frame(sigma_m**2 / (4 * KNOT_SPACING) * np.eye(3))
    information = 2 / sigma_m**2 * np.eye(3)  # half of the variance each
    pull = information @ [sigmas * sigma_m, 0, 0]
    drift_model.add_closure(np.array([0]), information[None], pull[None], np.zeros((3, 3)), 0.9999)
    assert (drift_model.take_correction(np.zeros(2)) is not None) == believed


def test_bends_of_less_than_a_millimetre_are_put_off():
    drift_model = DriftModel()
    for _ in range(2 * KNOT_SPACING):
        drift_model.add_frame(1e-2 * np.eye(3))

    def seen(shift_m: float) -> None:
        information = 1e6 * np.eye(3)
        pull = information @ [shift_m, 0.0, 0.0]
        drift_model.add_closure(
            np.array([0]), information[None], pull[None], np.zeros((3, 3)), SURE
        )

    seen(6e-4)
    assert drift_model.take_correction(np.zeros(2)) is None
    seen(2e-3)  # of the map as it is, so the mean of both
    found = drift_model.take_correction(np.zeros(2))
    assert found is not None
    assert found[-1, 0] == pytest.approx(1.3e-3, rel=1e-4)
    assert drift_model.take_correction(np.zeros(2)) is None


@pytest.mark.parametrize(("sigmas", "believed"), [(4.1, True), (4.45, False)])
def test_the_gate_counts_the_directions_that_are_seen(sigmas, believed):
    """The 0.9999 quantile of chi-square with 2 degrees of freedom is 18.4, 4.29 squared."""
    drift_model, sigma_m = DriftModel(), 0.03
    for _ in range(2 * KNOT_SPACING):
        drift_model.add_frame(sigma_m**2 / (4 * KNOT_SPACING) * np.diag([1, 1, 0]))
    information = 2 / sigma_m**2 * np.diag([1.0, 1.0, 0.0])  # half of the variance each
    pull = information @ [sigmas * sigma_m, 0, 0]
    drift_model.add_closure(np.array([0]), information[None], pull[None], np.zeros((3, 3)), 0.9999)
    assert (drift_model.take_correction(np.zeros(2)) is not None) == believed


def test_a_bend_is_due_where_it_moves_the_robot():
    """A turn of the plane about (2, 3) does not move a robot there; it moves one at (-2, -3)."""
    drift_model, about = DriftModel(), np.array([2.0, 3.0])
    for _ in range(2 * KNOT_SPACING):
        drift_model.add_frame(1e2 * np.eye(3))
    information = 1e6 * np.eye(3)
    pull = information @ (0.01 * np.array([about[1], -about[0], 1.0]))
    drift_model.add_closure(np.array([0]), information[None], pull[None], np.zeros((3, 3)), SURE)
    assert drift_model.take_correction(about) is None
    assert drift_model.take_correction(-about) is not None


GATE, SIGMA = 16.0, np.array([0.05, 0.03, 0.02])


class Evidence(DriftModel):
    """Drift model that records its closures."""

    def add_closure(self, frame, information, pull, now, probability):
        self.told = frame, information, pull, now


def loop(planar: bool) -> tuple[Evidence, FrameAssociation, ParticleMaps, np.ndarray, np.ndarray]:
    """Return ten landmarks in two particles: four in view, two groups of three seen earlier."""
    rng = np.random.default_rng(2)
    point = rng.uniform([1, -2, 0], [4, 2, 0 if planar else 1], (12, 3))
    covariance = np.array([root @ root.T for root in rng.normal(0, 0.02, (12, 3, 3))])
    covariance += 1e-4 * np.eye(3)
    poses = np.array([[0, 0, 0.0], [0.4, -0.2, 0.7]])
    maps = ParticleMaps(2, GATE)
    first = observations_in_map(poses, point, covariance, planar)
    frame = Observations(point, covariance)
    created, _ = maps.create(np.full((12, 2), NEW), first, frame, 0)
    moved = point + rng.normal(0, 0.02, point.shape) * [1, 1, 0 if planar else 1]
    seen = observations_in_map(poses, moved, covariance, planar)
    chosen = created.copy()
    chosen[10], chosen[11] = NEW, DROPPED
    drift_model = Evidence()
    for _ in range(5 * KNOT_SPACING):
        drift_model.add_frame(np.zeros((3, 3)))
    maps.slots.last_frame[created] = [
        *[5 * KNOT_SPACING - 3] * 4,
        *[3, 4, 6],
        *[2 * KNOT_SPACING] * 3,
        0,
        0,
    ]
    by_odometry = odometry_noise_factor(poses[1], 0.2, SIGMA)
    return drift_model, FrameAssociation(chosen, seen, 1, GATE, planar), maps, by_odometry, poses


def log_likelihood(frame: FrameAssociation, maps: ParticleMaps, rows, motion) -> float:
    """Return the log likelihood with Cauchy loss after a motion of the plane (x, y, angle)."""
    n, total = 2 if frame.planar else 3, 0.0
    upper = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
    for k in rows:
        r = maps.slots.row[frame.chosen[k]]
        Z = (
            maps.slots.by_particle.covariance_m2[r, 1][upper]
            + frame.sightings.covariance_m2[k, 1][upper]
        )
        point = rotation_about_z(motion[2]) @ frame.sightings.point_m[k, 1] + [*motion[:2], 0]
        off = (point - maps.slots.by_particle.mean_m[r, 1])[:n]
        total -= GATE / 2 * np.log(1 + off @ np.linalg.solve(Z[:n, :n], off) / GATE)
    return total


def slope(function, at) -> np.ndarray:
    step = 1e-5 * np.eye(3)
    return np.array([(function(at + h) - function(at - h)) / 2e-5 for h in step])


@pytest.mark.parametrize("planar", [False, True])
def test_evidence_is_the_slope_of_the_likelihood_at_the_pose_in_view(planar):
    drift_model, frame, maps, by_odometry, _ = loop(planar)
    close_loops(drift_model, maps.slots, frame, by_odometry, 0.9999)
    when, information, pull, now = drift_model.told
    assert when.tolist() == [13 / 3, 2 * KNOT_SPACING]

    def of_view(motion) -> float:
        eta = np.linalg.solve(by_odometry, motion)
        return log_likelihood(frame, maps, range(4), motion) - 0.5 * eta @ eta

    # the pose in view: by Newton's method on what differences tell
    motion = np.zeros(3)
    for _ in range(20):
        motion = motion + now @ slope(of_view, motion)
    for g, rows in enumerate(([4, 5, 6], [7, 8, 9])):
        gradient = slope(lambda at, rows=rows: log_likelihood(frame, maps, rows, at), motion)
        np.testing.assert_allclose(pull[g], gradient, rtol=0.02, atol=0.02 * np.abs(gradient).max())
    # far from the gate the loss is the squares', and so is its curvature
    wide = frame._replace(gate=1e12)
    drift_model.told = None
    close_loops(drift_model, maps.slots, wide, by_odometry, 0.9999)
    information, now = drift_model.told[1], drift_model.told[3]
    inverse = np.linalg.inv(now) - np.linalg.inv(by_odometry @ by_odometry.T)
    for rows, found in (([4, 5, 6], information[0]), (range(4), inverse)):
        points = frame.sightings.point_m[list(rows), 1]
        expected = np.zeros((3, 3))
        for k, (x, y, _) in zip(rows, points, strict=True):
            Z = 2 * frame.sightings.covariance_m2[k, 1][np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])]
            J = np.array([[1, 0, -y], [0, 1, x], [0, 0, 0]])[: 2 if planar else 3]
            n = len(J)
            expected += J.T @ np.linalg.solve(Z[:n, :n], J)
        np.testing.assert_allclose(found, expected, rtol=0.05, atol=0.05 * np.abs(expected).max())


def test_a_path_may_bend_by_the_share_of_the_frame_that_hangs_on_nothing():
    drift_model, frame, maps, by_odometry, _ = loop(planar=False)
    drift = close_loops(drift_model, maps.slots, frame, by_odometry, 0.9999)
    # six that come back and a new one, of twelve
    np.testing.assert_allclose(drift, 7 / 12 * drift_model.told[3], rtol=1e-12)


def test_fewer_than_three_together_close_nothing():
    drift_model, frame, maps, by_odometry, _ = loop(planar=False)
    chosen = frame.chosen.copy()
    chosen[[4, 7]] = DROPPED
    drift_model.told = None
    close_loops(drift_model, maps.slots, frame._replace(chosen=chosen), by_odometry, 0.9999)
    assert drift_model.told is None


def test_odometry_moves_the_plane_as_its_disturbance_moves_the_robot():
    before, odometry = np.array([2.0, -3.0, 0.7]), np.array([0.3, 0.05, 0.2])
    predicted, point = compose(before, odometry), np.array([[1.0, 0.5, 0.2]])
    by_odometry = odometry_noise_factor(predicted, odometry[2], SIGMA)
    seen = transform_points(predicted, point)[0]
    for i in range(3):
        eta = 1e-6 * np.eye(3)[i]
        moved = transform_points(compose(before, odometry + SIGMA * eta), point)[0]
        by_plane = transform_points(by_odometry @ eta, seen[None])[0]
        np.testing.assert_allclose(by_plane - seen, moved - seen, atol=1e-12)


@pytest.mark.parametrize("settled", [False, True])
def test_landmarks_of_all_particles_move_and_are_found_where_they_are_now(settled):
    rng = np.random.default_rng(1)
    n = 150
    observations = Observations(rng.uniform(-5, 5, (n, 3)), np.tile(0.01 * np.eye(3), (n, 1, 1)))
    poses, given = rng.normal(0, 0.1, (3, 3)), (observations.position_m, observations.covariance_m2)
    seen = observations_in_map(poses, *given, planar=False)
    maps = ParticleMaps(3, 9.0)
    slots, _ = maps.create(np.full((n, 3), NEW), seen, observations, 0)
    same = np.zeros(3, dtype=np.int32)
    for _ in range(MEMORY if settled else 0):
        maps.resample(same)
    assert (maps.n_rows == 0) == settled
    T = rng.normal(0, [0.3, 0.3, 0.1], (len(maps.slots.source), 3))
    maps.transform(T)
    for particle in range(3):
        which, known = maps.landmarks_of(particle, 1)
        own = seen.point_m[:, 0 if settled else particle]
        for s, old, new in zip(which, own, known.mean_m, strict=True):
            np.testing.assert_allclose(new, transform_points(T[s], old[None])[0], atol=1e-12)
            box = np.array([*new[:2], *new[:2]])
            assert s in slots_near(maps.slots, box)
    assert len(slots) == n


def blind_loop(seed: int, close_loops: bool) -> FastSlam:
    """One particle goes away and comes back without a look but one half way, to where it was.

    Its odometry has no error but what is drawn, which grows evenly and leaves the heading alone.
    """
    rng, n = np.random.default_rng(seed), 2 * KNOT_SPACING
    motion = MotionNoise(0.05, 0, 0, 0, 0, lateral_m_per_sqrt_m=0.05, lateral_slip_m_per_rad=0)
    settings = parameters(
        n_particles=1,
        motion=motion,
        proposal="informed",
        association="label",
        gate_probability=1 - 1e-12,
        close_loops=close_loops,
    )
    slam, point = FastSlam(settings, np.random.default_rng(seed)), rng.uniform(-3, 3, (6, 3))
    label = np.arange(6, dtype=np.int32)
    start = Observations(point, np.tile(1e-10 * np.eye(3), (6, 1, 1)), label=label)
    slam.step(np.zeros(3), start)
    for k in range(1, n):
        seen = replace(start, label=label + 6) if k == KNOT_SPACING else nothing()
        slam.step(np.array([0.1 if k <= KNOT_SPACING else -0.1, 0, 0]), seen)
    slam.step(np.array([-0.1, 0, 0]), start)
    return slam


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_path_and_landmarks_of_a_loop_without_a_look_are_a_line_between_its_ends(seed):
    """A random walk with known ends: its conditional mean adds a linear function."""
    bent, free = blind_loop(seed, True), blind_loop(seed, False)
    n = 2 * KNOT_SPACING
    drawn, path = free.best_path()[:n], bent.best_path()
    off = -drawn[-1, :2] + np.array([0.1, 0.0])
    found = path[:n, :2] - drawn[:, :2]
    # The last of n steps is the closing frame's, and is left to the proposal. Pairs this far off
    # say less than they might, as Cauchy's weights have it.
    expected = np.arange(n)[:, None] / n * off
    np.testing.assert_allclose(found, expected, atol=0.01 * np.abs(off).max())
    before, after = (slam.best_map(min_count=1) for slam in (free, bent))
    half_way = slice(6, 12)
    moved = after.position_m[half_way] - before.position_m[half_way]
    np.testing.assert_allclose(moved[:, :2], np.tile(found[KNOT_SPACING], (6, 1)), atol=1e-9)
    assert np.abs(off).max() > 0.02


def test_without_a_loop_nothing_bends():
    world = drive(0, n_frames=KNOT_SPACING)
    paths = []
    for close in (True, False):
        slam = FastSlam(
            parameters(proposal="informed", close_loops=close), np.random.default_rng(0)
        )
        for odometry, frame in zip(world.odometry, world.frames, strict=True):
            slam.step(odometry, frame)
        slam.step(np.array([0.1, 0, 0]), nothing())
        paths.append(slam.best_path())
    np.testing.assert_array_equal(*paths)


@pytest.mark.parametrize("seed", range(4))
def test_after_two_closures_landmarks_lie_where_the_poses_saw_them(seed, monkeypatch):
    """Landmarks that were seen once keep their place relative to the pose that saw them.

    One particle drives in circles and sees landmarks in six frames. Groups 0 and 1 are seen twice
    and close a loop each; groups 2 and 3 are seen once, before and after the first closure. The
    path follows the odometry across both closures.
    """
    n = 4 * KNOT_SPACING
    looks = {
        0: 0,
        KNOT_SPACING: 1,
        KNOT_SPACING + 10: 2,
        2 * KNOT_SPACING + 2: 0,
        3 * KNOT_SPACING: 3,
        n - 10: 1,
    }
    odometry = np.tile([0.1, 0.0, 0.06], (n, 1))
    odometry[0] = 0.0
    truth, rng = [np.zeros(3)], np.random.default_rng(seed)
    for step in odometry[1:]:
        truth.append(compose(truth[-1], step))
    points = rng.uniform(-3, 4, (4, 6, 3))
    motion = MotionNoise(
        0.02, 0.03, 0.01, 0, 0, lateral_m_per_sqrt_m=0.02, lateral_slip_m_per_rad=0
    )
    settings = parameters(
        n_particles=1,
        motion=motion,
        proposal="informed",
        association="label",
        gate_probability=1 - 1e-12,
        close_loops=True,
    )
    turned, correct = [], PathHistory.correct

    def counted(self, T_map_bent):
        turned.append(np.abs(T_map_bent[:, 2]).max())
        correct(self, T_map_bent)

    monkeypatch.setattr(PathHistory, "correct", counted)
    slam = FastSlam(settings, np.random.default_rng(seed))
    seen = {}
    for frame, step in enumerate(odometry):
        if (group := looks.get(frame)) is None:
            slam.step(step, nothing())
            continue
        at = transform_points(inverse(truth[frame]), points[group])
        label = (6 * group + np.arange(6)).astype(np.int32)
        seen[frame] = at
        slam.step(step, Observations(at, np.tile(0.01 * np.eye(3), (6, 1, 1)), label=label))
    assert sum(turn > 0.01 for turn in turned) == 2
    path, found = slam.best_path(), slam.best_map(min_count=1)
    for frame in (KNOT_SPACING + 10, 3 * KNOT_SPACING):
        rows = np.flatnonzero(found.label // 6 == looks[frame])
        own = transform_points(inverse(path[frame]), found.position_m[rows])
        np.testing.assert_allclose(own, seen[frame], atol=1e-9)
    for frame in (2 * KNOT_SPACING + 2, n - 10):
        off = between(path[frame - 1], path[frame]) - odometry[frame]
        assert np.all(np.abs(off) < 6 * motion.standard_deviations(odometry[frame]))


class KnownDrift(AnyFrames):
    """Dense Gaussian of the drift at some knots and at present, of any covariance."""

    def __init__(self, seed: int, frames: np.ndarray) -> None:
        super().__init__(np.zeros((1, 3, 3)), np.zeros(len(frames), dtype=int))
        root = 0.05 * np.random.default_rng(seed).standard_normal((3 * len(frames),) * 2)
        self.frames, self.covariance = frames, root @ root.T

    def model(self) -> DriftModel:
        return DriftModel.at_knots(int(self.frames[-1]), self.frames[:-1], self.covariance.copy())

    def covariances(self, frame: np.ndarray) -> Float:
        """Return the covariances (n, 3, 3) of the drift, linear between the frames."""
        weight = np.array(
            [np.interp(frame, self.frames, each) for each in np.eye(len(self.frames))]
        )
        slope = np.einsum("kn,ij->nikj", weight, np.eye(3)).reshape(len(frame), 3, -1)
        return slope @ self.covariance @ slope.transpose(0, 2, 1)


# Knots of other robots, which have negative frames, and of the robot itself.
KNOTS = np.array([-61, -40, -21, -20, -1, 0, 25, 50, 73])


def test_covariances_of_a_known_drift_are_those_of_linear_interpolation():
    dense, frame = KnownDrift(0, KNOTS), np.arange(-61, 74)
    np.testing.assert_allclose(
        dense.model().covariances(frame), dense.covariances(frame), atol=1e-15
    )


@pytest.mark.parametrize("then", [-61, -20, 0, 50])
def test_closures_of_a_known_drift_are_those_of_dense_algebra(then):
    rng, dense = np.random.default_rng(then + 100), KnownDrift(1, KNOTS)
    drift_model = dense.model()
    noise, now, motion = spread_matrix(rng, 0.02), spread_matrix(rng, 0.01), rng.normal(0, 0.05, 3)
    before = drift_model.covariances(KNOTS)
    information = np.linalg.inv(noise)
    pull = information @ motion
    drift_model.add_closure(np.array([then]), information[None], pull[None], now, SURE)
    dense.add_closure(73, then, motion, noise + now)
    frame = np.arange(-61, 74)
    np.testing.assert_allclose(drift_model.covariances(frame), dense.covariances(frame), atol=1e-12)
    found = drift_model.take_correction(FAR)
    assert found is not None
    np.testing.assert_allclose(found, dense.mean.reshape(-1, 3), atol=1e-12)
    less = before - drift_model.covariances(KNOTS)
    assert np.linalg.eigvalsh(less).min() > -1e-12
    assert np.trace(less[then == KNOTS][0]) > 1e-4


def test_a_known_drift_goes_on_with_the_path():
    """The present drift grows by what is added; knots follow, and the known ones stay."""
    rng, dense = np.random.default_rng(0), KnownDrift(2, KNOTS)
    drift_model = dense.model()
    steps = [spread_matrix(rng, 0.01) for _ in range(3 * KNOT_SPACING)]
    for step in steps:
        drift_model.add_frame(step)
    last = 73 + 3 * KNOT_SPACING
    assert drift_model.frame == last
    found = drift_model.covariances(np.array([*KNOTS, last]))
    np.testing.assert_allclose(found[:-1], dense.covariances(KNOTS), atol=1e-14)
    expected = dense.covariances(KNOTS[-1:])[0] + np.sum(steps, axis=0)
    np.testing.assert_allclose(found[-1], expected, atol=1e-13)
