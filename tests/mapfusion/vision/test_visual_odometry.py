"""Tests of `mapfusion.vision.visual_odometry`."""

from itertools import combinations, pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapfusion.attitude import Attitude
from mapfusion.camera import StereoCamera
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.geometry.se2 import between, transform_points
from mapfusion.vision.visual_odometry import (
    _ALL_AFTER,
    _DAMPING,
    _STEPS,
    _TOLERANCES_M,
    MIN_LINKS,
    RigidMotion,
    estimate_rigid_motion,
    initial_subsets,
    visual_odometry,
)

CAMERA = StereoCamera()
MOUNT = se3.pose(Rotation.from_euler("ZYX", [0.2, 0.1, -0.05]).as_matrix(), [0.4, 0.1, 1.2])
MOVED = np.array([[0.5, 0.02, 0.1], [0.3, -0.01, -0.2]])  # of the robot


def of_camera(T_robot: np.ndarray) -> np.ndarray:
    """The motion that a camera on the mount takes it for, which thinks itself level."""
    taken = se3.pose(np.eye(3), CAMERA.p_robot_left)
    T = MOUNT @ se3.inverse(taken)
    return se3.inverse(T) @ T_robot @ T


def found(motions: list, steps: list[float]):
    return visual_odometry(motions, np.array(steps), CAMERA, MOUNT)


def test_a_tilted_camera_tells_the_robot_s_motion() -> None:
    motions = [RigidMotion(of_camera(T), np.eye(6), 9) for T in se3.from_planar(MOVED)]
    made = found([None, *motions], [0, 1, 1])
    np.testing.assert_allclose(made.increments[1:], MOVED, atol=1e-12)
    assert np.all(made.increments[0] == 0)
    assert not made.guessed.any()


def test_the_covariance_is_the_spread_of_the_errors() -> None:
    rng = np.random.default_rng(0)
    root = 1e-3 * rng.normal(size=(6, 6))
    true = of_camera(se3.from_planar(MOVED[0]))
    drawn = (root @ rng.standard_normal((6, 10_000))).T
    T = np.tile(true, (len(drawn), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(drawn[:, 3:]).as_matrix() @ T[:, :3, :3]
    T[:, :3, 3] += drawn[:, :3]
    covariance = root @ root.T
    motions = [None, *(RigidMotion(each, covariance, 9) for each in T)]
    made = found(motions, [1.0] * len(motions))
    spread = np.cov((made.increments[1:] - MOVED[0]).T)
    scale = np.sqrt(np.diag(spread))
    np.testing.assert_allclose(
        made.covariance[1] / np.outer(scale, scale), spread / np.outer(scale, scale), atol=0.05
    )


def test_without_links_the_robot_goes_on_as_before() -> None:
    T = RigidMotion(of_camera(se3.from_planar(MOVED[0])), 1e-6 * np.eye(6), 9)
    made = found([None, T, None, None], [1, 1, 1, 3])
    np.testing.assert_allclose(made.increments[2], MOVED[0], atol=1e-12)
    np.testing.assert_allclose(made.increments[3], 3 * MOVED[0], atol=1e-12)
    assert made.guessed.tolist() == [False, False, True, True]
    assert np.all(np.diagonal(made.covariance[2]) >= MOVED[0] ** 2)


def test_a_guess_errs_by_the_largest_step_so_far() -> None:
    """A car that stood still may have begun to move as fast as it was before."""
    fast, slow = (RigidMotion(of_camera(se3.from_planar(step)), 1e-8 * np.eye(6), 9)
                  for step in np.array([[2.0, 0.0, 0.3], [0.0, 0.0, 0.0]]))  # fmt: skip
    made = found([None, None, fast, slow, None], [1, 1, 1, 1, 1])
    sigma = np.sqrt(np.diagonal(made.covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(sigma[1], [0.1, 0.1, 0.1])
    np.testing.assert_allclose(sigma[4], [2.0, 0.1, 0.3], atol=1e-9)


def test_a_guess_is_of_the_speed_and_errs_with_the_time() -> None:
    """The speed is the last motion over its steps; a guess is the speed times the steps."""
    T = RigidMotion(of_camera(se3.from_planar(MOVED[0])), 1e-6 * np.eye(6), 9)
    made = found([None, T, None], [1, 2, 3])
    speed = MOVED[0] / 2
    np.testing.assert_allclose(made.increments[2], 3 * speed, atol=1e-12)
    sigma = 3 * np.abs(speed) + 3 * np.maximum(np.abs(speed), 0.1)
    np.testing.assert_allclose(made.covariance[2], np.diag(sigma**2), atol=1e-12)


# Roll, pitch and height of the body in three frames, and where it is in the plane.
TILTS = np.array([[0.1, -0.05, 0.0], [-0.2, 0.15, 0.0], [0.05, 0.25, 0.0]])
PATH = np.array([[1.0, 2.0, 0.5], [1.6, 2.3, 0.9], [1.9, 3.0, 2.0]])
SWAYING = Attitude(TILTS, np.zeros((3, 3)), np.zeros((3, 2)))


def test_a_swaying_body_moves_in_the_plane_as_its_level_frame_does() -> None:
    T_world_body = se3.in_space(PATH, TILTS[:, :2])
    motions = [
        RigidMotion(of_camera(se3.inverse(before) @ after), 1e-6 * np.eye(6), 9)
        for before, after in pairwise(T_world_body)
    ]
    made = visual_odometry([None, *motions], np.ones(3), CAMERA, MOUNT, SWAYING)
    np.testing.assert_allclose(made.increments[1:], between(PATH[:-1], PATH[1:]), atol=1e-12)


def test_a_swaying_body_s_covariance_is_that_of_its_increments_by_differences() -> None:
    T_world_body = se3.in_space(PATH, TILTS[:, :2])
    true = se3.inverse(T_world_body[1]) @ T_world_body[2]
    root = np.random.default_rng(1).normal(size=(6, 6))
    mount = se3.pose(np.eye(3), CAMERA.p_robot_left)  # the camera is where it was taken to be

    def told(error: np.ndarray):
        turn = Rotation.from_rotvec(error[3:]).as_matrix()
        T = se3.pose(turn @ true[:3, :3], true[:3, 3] + error[:3])
        attitude = Attitude(TILTS[1:], np.zeros((2, 3)), np.zeros((2, 2)))
        motions = [None, RigidMotion(T, root @ root.T, 9)]
        return visual_odometry(motions, np.ones(2), CAMERA, mount, attitude)

    step = 1e-6 * np.eye(6)
    J = np.array([told(h).increments[1] - told(-h).increments[1] for h in step]).T / 2e-6
    expected, found = J @ root @ root.T @ J.T, told(np.zeros(6)).covariance[1]
    scale = np.sqrt(np.diag(expected))
    # the heading's error is taken for the turn about the upright: to first order in the tilt
    np.testing.assert_allclose(
        found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.15
    )
    np.testing.assert_allclose(found[:2, :2], expected[:2, :2], rtol=1e-6, atol=1e-9)


SIGMA_UV_PX, SIGMA_DISPARITY_PX = 0.3, 0.2
MOTION = np.array([0.1, 0.01, 0.09])  # T_before_after of a robot that drives and turns fast


def seen(p_robot: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Noisy stereo points and their covariances."""
    uvd = CAMERA.project(p_robot) + rng.standard_normal((len(p_robot), 3)) * [
        SIGMA_UV_PX,
        SIGMA_UV_PX,
        SIGMA_DISPARITY_PX,
    ]
    return CAMERA.triangulate(uvd[:, :2], uvd[:, 2], SIGMA_UV_PX, SIGMA_DISPARITY_PX)


def frames(n: int, rng: np.random.Generator, motion: np.ndarray = MOTION) -> tuple:
    after = rng.uniform((2, -1.5, 0), (6, 1.5, 2), (n, 3))
    return (*seen(transform_points(motion, after), rng), *seen(after, rng))


@pytest.mark.parametrize(("turn_rad", "repeats"), [(0.09, 200), (0.5, 60)])
def test_true_links_pass_at_the_stated_rate(turn_rad: float, repeats: int) -> None:
    """Also where the far longer uncertainty in depth points elsewhere in the frame before."""
    rng = np.random.default_rng(0)
    motion = np.array([0.1, 0.01, turn_rad])
    passed = [
        estimate_rigid_motion(*frames(60, rng, motion), probability=0.9)[0] for _ in range(repeats)
    ]
    # The three numbers of the motion are fitted to the links themselves and to those that pass, so
    # the share lies by some parts in a thousand off; 12 000 links tell it to 0.003.
    assert np.mean(passed) == pytest.approx(0.9, abs=0.015)


def tilting(rng: np.random.Generator) -> np.ndarray:
    """T_before_after of a camera in somebody's hand."""
    turn = Rotation.from_rotvec(rng.uniform(-0.15, 0.15, 3)).as_matrix()
    return se3.pose(turn, rng.uniform(-0.2, 0.2, 3))


def moved_frames(n: int, rng: np.random.Generator, T: np.ndarray) -> tuple:
    after = rng.uniform((2, -1.5, 0), (6, 1.5, 2), (n, 3))
    return (*seen(after @ T[:3, :3].T + T[:3, 3], rng), *seen(after, rng))


def test_any_motion_of_space_keeps_its_links_and_is_found() -> None:
    rng = np.random.default_rng(6)
    for _ in range(30):
        T = tilting(rng)
        after = rng.uniform((2, -1.5, 0), (6, 1.5, 2), (40, 3))
        S = np.tile(np.eye(3) * 0.01**2, (40, 1, 1))
        agree, motion = estimate_rigid_motion(after @ T[:3, :3].T + T[:3, 3], S, after, S, 0.999)
        assert agree.all()
        assert motion is not None
        np.testing.assert_allclose(motion.T_before_after, T, atol=1e-9)


def test_errors_of_the_motion_obey_its_covariance() -> None:
    """The mean squared normalised error is 1 per degree of freedom within a tenth."""
    rng = np.random.default_rng(7)
    squares = []
    for _ in range(300):
        T = tilting(rng)
        _, motion = estimate_rigid_motion(*moved_frames(60, rng, T), 0.999)
        assert motion is not None
        turn = Rotation.from_matrix(T[:3, :3] @ motion.T_before_after[:3, :3].T).as_rotvec()
        error = np.concatenate([(T - motion.T_before_after)[:3, 3], turn])
        squares.append(error @ np.linalg.solve(motion.covariance, error))
    # the excess is 1 or more, so that chance makes covariances a little too wide, never too tight
    assert 0.8 < np.mean(squares) / 6 < 1.1


def test_noise_beyond_what_is_stated_widens_the_covariance() -> None:
    rng = np.random.default_rng(8)
    before, S_before, after, S_after = moved_frames(200, rng, tilting(rng))
    _, stated = estimate_rigid_motion(before, S_before, after, S_after, 0.999)
    _, doubted = estimate_rigid_motion(before, S_before / 4, after, S_after / 4, 1 - 1e-9)
    assert stated is not None
    assert doubted is not None
    ratio = np.sqrt(np.diag(doubted.covariance) / np.diag(stated.covariance))
    np.testing.assert_allclose(ratio, 1, atol=0.15)


@pytest.mark.parametrize("share", [0.05, 0.2, 0.4])
def test_slips_are_cut_and_the_rest_is_kept(share: float) -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        before, S_before, after, S_after = frames(40, rng)
        slipped = np.arange(40) < round(share * 40)
        uvd = CAMERA.project(before)
        uvd[slipped, :2] += rng.choice([-1, 1], (slipped.sum(), 2)) * rng.uniform(
            5, 10, (slipped.sum(), 2)
        )
        before, S_before = CAMERA.triangulate(
            uvd[:, :2], uvd[:, 2], SIGMA_UV_PX, SIGMA_DISPARITY_PX
        )
        agree, _ = estimate_rigid_motion(before, S_before, after, S_after, 0.999)
        assert not agree[slipped].any()
        assert agree[~slipped].mean() > 0.9


def test_another_robot_is_cut() -> None:
    rng = np.random.default_rng(2)
    still, other = frames(30, rng), frames(8, rng, np.array([0.25, 0.1, -0.05]))
    together = (np.concatenate([a, b]) for a, b in zip(still, other, strict=True))
    agree, _ = estimate_rigid_motion(*together, probability=0.999)
    assert agree[:30].all()
    assert agree[30:].sum() <= 1


def test_a_robot_that_passes_close_before_walls_is_cut() -> None:
    """Walls at like distances hardly tell a turn from a slide; near points must not decide."""
    rng = np.random.default_rng(8)
    wall = rng.uniform((3.5, -1.4, 0.2), (4.7, 1.4, 2), (80, 3))
    body = rng.uniform((1.1, 0.0, 0.05), (1.2, 0.35, 0.25), (5, 3))
    before = seen(np.concatenate([wall, body - np.array([0, 0.087, 0])]), rng)
    after = seen(np.concatenate([wall, body]), rng)
    agree, _ = estimate_rigid_motion(*before, *after, probability=0.999)
    assert agree[:80].mean() > 0.95
    assert not agree[80:].any()


def test_finds_the_largest_set_that_one_motion_explains() -> None:
    """Against all subsets of eight links, noise-free but for two slips."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        after = rng.uniform((2, -1.5, 0), (6, 1.5, 2), (8, 3))
        before = transform_points(MOTION, after)
        wrong = rng.choice(8, 2, replace=False)
        before[wrong] += rng.choice([-1, 1], (2, 3)) * rng.uniform(0.3, 0.6, (2, 3))
        S = np.tile(np.eye(3) * 0.01**2, (8, 1, 1))
        agree, _ = estimate_rigid_motion(before, S, after, S, 0.999)
        best = max(
            (rows for n in (8, 7, 6) for rows in combinations(range(8), n)),
            key=lambda rows: (explained(before[list(rows)], after[list(rows)]), len(rows)),
        )
        assert np.flatnonzero(agree).tolist() == list(best)


def explained(before: np.ndarray, after: np.ndarray) -> bool:
    """Return True if one turn about the height axis and one shift map the points to each other."""
    a, b = before[:, :2] - before[:, :2].mean(0), after[:, :2] - after[:, :2].mean(0)
    turn = np.angle(np.sum((a[:, 0] + 1j * a[:, 1]) * (b[:, 0] - 1j * b[:, 1])))
    left = a - transform_points([0, 0, turn], b)
    return bool(np.abs(left).max() < 0.05 and np.abs(before[:, 2] - after[:, 2]).max() < 0.05)


def test_units_do_not_matter() -> None:
    before, S_before, after, S_after = frames(40, np.random.default_rng(4))
    before[:4] += 0.2
    metres, _ = estimate_rigid_motion(before, S_before, after, S_after, 0.99)
    millimetres, _ = estimate_rigid_motion(
        before * 1e3, S_before * 1e6, after * 1e3, S_after * 1e6, 0.99
    )
    assert metres.tolist() == millimetres.tolist()
    assert 0 < metres.sum() < 40


@pytest.mark.parametrize("n", [0, 1, 3])
def test_too_few_to_compare_are_kept(n: int) -> None:
    assert (
        estimate_rigid_motion(*frames(n, np.random.default_rng(5)), probability=0.5)[0].tolist()
        == [True] * n
    )


def test_one_point_seen_many_times_is_no_error() -> None:
    p = np.tile([3.0, 0.0, 1.0], (6, 1))
    S = np.tile(np.eye(3) * 1e-4, (6, 1, 1))
    assert estimate_rigid_motion(p, S, p, S, 0.999)[0].all()


def rigid_motion_twin(
    p_before_m: Float,
    covariance_before_m2: Float,
    p_after_m: Float,
    covariance_after_m2: Float,
    probability: float,
) -> tuple[np.ndarray, Float | None]:
    """Return the links of `estimate_rigid_motion` and T_before_after (4, 4), by NumPy and SciPy."""
    n = len(p_before_m)
    if n < MIN_LINKS:
        return np.ones(n, dtype=bool), None
    gate = chi_square_bound(probability, 3)
    start = initial_subsets(p_before_m)
    agree, R, t = start, np.tile(np.eye(3), (len(start), 1, 1)), np.zeros((len(start), 3))
    for i, tolerance_m in enumerate(_TOLERANCES_M):
        S = covariance_before_m2 + tolerance_m**2 * np.eye(3)
        for _ in range(_STEPS):
            R, t, square = twin_step(R, t, agree, p_before_m, S, p_after_m, covariance_after_m2)
        agree = np.less_equal(square, gate)
        if i < _ALL_AFTER:
            agree &= start
    best = np.argmax(agree.sum(axis=1))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R[best], t[best]
    return agree[best], T if agree[best].sum() >= MIN_LINKS else None


def twin_step(
    R: Float,
    t: Float,
    used: np.ndarray,
    p_before: Float,
    S_before: Float,
    p_after: Float,
    S_after: Float,
) -> tuple[Float, Float, Float]:
    """Take a Gauss-Newton step for B motions (B, 3, 3) and (B, 3) over their links (B, N).

    Returns:
        The motions, and all squared distances (B, N) after the step.
    """
    turn = R[:, None]
    information = np.linalg.inv(S_before + turn @ S_after @ turn.swapaxes(-1, -2))
    arm = p_after @ R.swapaxes(-1, -2)
    residual = p_before - arm - t[:, None]
    jacobian = np.zeros((*used.shape, 3, 6))  # d(moved point) / d(shift, turn)
    jacobian[..., :3] = np.eye(3)
    for k in range(3):
        jacobian[..., 3 + k] = np.cross(np.eye(3)[k], arm)
    weighted = used[..., None, None] * (jacobian.swapaxes(-1, -2) @ information)
    normal = np.sum(weighted @ jacobian, axis=1)
    normal = normal + _DAMPING * np.eye(6) * normal
    right = np.sum(weighted @ residual[..., None], axis=1)
    some = used.any(axis=1)
    step = np.zeros((len(used), 6))
    step[some] = np.linalg.solve(normal[some], right[some])[..., 0]
    residual = residual - (jacobian @ step[:, None, :, None])[..., 0]
    square = np.sum(residual * (information @ residual[..., None])[..., 0], axis=-1)
    return Rotation.from_rotvec(step[:, 3:]).as_matrix() @ R, t + step[:, :3], square


@pytest.mark.parametrize("n", [4, 5, 12, 80])
def test_equals_the_twin(n: int) -> None:
    """Among slips small and large, and where all points but a few, or all, are one."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        before, S_before, after, S_after = frames(n, rng, rng.normal(0, [0.1, 0.02, 0.2]))
        slipped = rng.random(n) < rng.uniform(0, 0.5)
        before[slipped] += rng.normal(0, 10 ** rng.uniform(-2, 0), (slipped.sum(), 3))
        same = rng.random(n) < (0.0, 0.0, 0.5, 1.0)[seed % 4]
        before[same], after[same] = [3.1, 0.1, 1.0], [3.0, 0.0, 1.0]
        S_before[same], S_after[same] = 1e-4 * np.eye(3), 2e-4 * np.eye(3)
        links = before, S_before, after, S_after, 0.99
        agree, motion = estimate_rigid_motion(*links)
        same, T = rigid_motion_twin(*links)
        assert agree.tolist() == same.tolist()
        assert (motion is None) == (T is None)
        if seed % 4 < 2 and motion is not None and T is not None:  # else turns are open
            np.testing.assert_allclose(motion.T_before_after, T, atol=1e-9)
