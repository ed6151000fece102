"""What heights of landmarks have in common, against the spread of attitudes drawn step by step."""

import numpy as np
import pytest

from mapfusion.attitude import Attitude, shared_heights
from mapfusion.geometry import se2

N_FRAMES, N_LANDMARKS = 40, 5
FIRST, STEP = np.array([0.01, 0.0]), np.array([2e-4, 1e-3])  # sigma of tilts (rad), heights (m)


def a_drive(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A path, frames and landmarks of sightings, and the landmarks."""
    path = np.zeros((N_FRAMES, 3))
    for k in range(1, N_FRAMES):
        path[k] = se2.compose(path[k - 1], np.array([0.2, 0.0, 0.05]))
    landmark = np.repeat(np.arange(N_LANDMARKS), 4)
    frame = rng.integers(2, N_FRAMES, len(landmark))
    return path, frame, landmark, rng.uniform(-5, 5, (N_LANDMARKS, 3))


def drawn_errors(
    rng: np.random.Generator, path: np.ndarray, carried: np.ndarray, n: int
) -> np.ndarray:
    """(T, n, 3) tilts about the map's axes, and heights, as one follows from the other."""
    errors = np.zeros((N_FRAMES, n, 3))
    errors[0] = rng.standard_normal((n, 3)) * FIRST[[0, 0, 1]]
    for k in range(1, N_FRAMES):
        dx, dy = path[k, :2] - path[k - 1, :2]
        before = errors[k - 1]
        climbed = before[:, 2] + before[:, 0] * dy - before[:, 1] * dx
        kept = np.column_stack([before[:, :2] * carried[0], climbed * carried[1]])
        errors[k] = kept + rng.standard_normal((n, 3)) * STEP[[0, 0, 1]]
    return errors


@pytest.mark.parametrize("carried", [(1.0, 1.0), (0.9, 1.0), (0.8, 0.7)])
def test_they_spread_as_stated(carried: tuple[float, float]) -> None:
    rng = np.random.default_rng(0)
    path, frame, landmark, point = a_drive(rng)
    errors = drawn_errors(rng, path, np.array(carried), 20_000)
    sigma = errors.std(axis=1)
    sigma[:, :2] = sigma[:, :2].mean(axis=1, keepdims=True)
    told = Attitude(np.zeros_like(sigma), sigma, np.tile(carried, (N_FRAMES, 1)))
    arm = point[landmark, :2] - path[frame, :2]
    own = errors[frame]
    lifted = own[:, :, 0] * arm[:, 1:] - own[:, :, 1] * arm[:, :1] + own[:, :, 2]
    spread = np.cov(lifted.reshape(N_LANDMARKS, 4, -1).mean(axis=1))
    shared = shared_heights(told, path, frame, landmark, point)
    scale = np.sqrt(np.diag(spread))
    found = shared.T @ shared / np.outer(scale, scale)
    np.testing.assert_allclose(found, spread / np.outer(scale, scale), atol=0.05)


def test_a_tilt_at_first_tilts_the_whole_map() -> None:
    path, frame, landmark, point = a_drive(np.random.default_rng(1))
    sigma = np.tile([0.01, 0.01, 0.0], (N_FRAMES, 1))
    sigma[:, 2] = 0.01 * np.hypot(*path[:, :2].T)  # a tilted robot climbs, and does nothing else
    told = Attitude(np.zeros_like(sigma), sigma, np.ones((N_FRAMES, 2)))
    shared = shared_heights(told, path, frame, landmark, point)
    expected = 1e-4 * point[:, :2] @ point[:, :2].T
    np.testing.assert_allclose(shared.T @ shared, expected, atol=1e-12)


def test_long_logs_have_no_more_of_them() -> None:
    """Frames that share a source err a little more together than they would alone."""
    n = 500
    path = np.column_stack([np.linspace(0, 1, n), np.zeros((n, 2))])
    sigma = 1e-3 * np.sqrt(np.arange(1, n + 1))[:, None] * [1.0, 1.0, 5.0]
    told = Attitude(np.zeros((n, 3)), sigma, np.ones((n, 2)))
    point = path[[100, 499]] + [0.0, 3.0, 0.0]
    shared = shared_heights(told, path, np.array([100, 499]), np.array([0, 1]), point)
    assert len(shared) <= 3 * 65
    stated = 9 * sigma[[100, 499], 0] ** 2 + sigma[[100, 499], 2] ** 2
    assert np.sum(shared**2, axis=0) == pytest.approx(stated, rel=0.1)


def test_a_frame_measured_for_itself_shares_nothing_with_those_before() -> None:
    """Frame 3 carries nothing, so its error is independent of the errors before it."""
    path = np.column_stack([0.3 * np.arange(6.0), np.zeros((6, 2))])
    carried = np.ones((6, 2))
    carried[3] = 0.0
    told = Attitude(np.zeros((6, 3)), np.tile([0.01, 0.01, 0.005], (6, 1)), carried)
    frame, point = np.arange(6), path + np.array([1.0, 2.0, 0.0])
    shared = shared_heights(told, path, frame, np.arange(6), point)
    both = shared.T @ shared
    assert not both[:3, 3:].any()
    assert np.all(both[:3, :3] > 0)
    assert np.all(both[3:, 3:] > 0)


def test_a_tilt_of_any_heading_is_the_mean_of_the_variances_of_roll_and_pitch() -> None:
    """Roll lifts what is beside the robot, pitch what is ahead; the test averages over headings."""
    roll_rad, pitch_rad, heading = 0.01, 0.03, np.linspace(-np.pi, np.pi, 8, endpoint=False)
    sigma = np.tile([roll_rad, pitch_rad, 0.0], (1, 1))
    told = Attitude(np.zeros((1, 3)), sigma, np.zeros((1, 2)))
    arm = np.array([2.0, 1.0, 0.0])
    shared = shared_heights(told, np.zeros((1, 3)), np.array([0]), np.array([0]), arm[None])
    ahead = arm[0] * np.cos(heading) + arm[1] * np.sin(heading)
    beside = arm[1] * np.cos(heading) - arm[0] * np.sin(heading)
    expected = np.mean((beside * roll_rad) ** 2 + (ahead * pitch_rad) ** 2)
    assert np.sum(shared**2) == pytest.approx(expected)
