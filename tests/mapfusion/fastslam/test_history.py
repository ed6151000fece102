import numpy as np
import pytest

from mapfusion.fastslam.particles import History


def lives(n_particles: int, n_steps: int, resampled_every: int) -> tuple[History, list]:
    """A history of made-up steps, and the same as each particle of today would tell it."""
    rng = np.random.default_rng(3)
    history = History()
    told: list = [([], []) for _ in range(n_particles)]
    for step in range(n_steps):
        poses = rng.normal(size=(n_particles, 3))
        source = rng.integers(-1, 100, (rng.integers(3), n_particles), dtype=np.int32)
        history.add(poses, source)
        for m, (path, associations) in enumerate(told):
            path.append(poses[m])
            associations.extend(source[:, m])
        if step % resampled_every == 0:
            ancestors = np.sort(rng.integers(n_particles, size=n_particles)).astype(np.int32)
            history.resampled(ancestors)
            told = [(list(told[a][0]), list(told[a][1])) for a in ancestors]
    return history, told


@pytest.mark.parametrize("n_steps", [0, 255, 256, 1500])
def test_each_particle_tells_its_own_life(n_steps: int) -> None:
    history, told = lives(5, n_steps, resampled_every=7)
    for m, (path, associations) in enumerate(told):
        np.testing.assert_array_equal(history.path(m), np.reshape(path, (-1, 3)))
        assert history.associations(m).tolist() == associations


def test_one_life_is_kept_from_where_all_lines_have_met() -> None:
    """Without pruning 2500 steps keep 12 500 particles; unpruned are 256 steps at most."""
    history, _ = lives(5, 2500, resampled_every=2)
    assert history.n_kept < 2500 + 5 * 256


def matrix(T: np.ndarray) -> np.ndarray:
    """(3, 3) homogeneous matrix of a pose or motion of the plane."""
    x, y, angle = T
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, x], [sin, cos, y], [0, 0, 1]])


def test_each_bend_moves_the_path_as_the_bends_before_left_it() -> None:
    """The path equals a product of matrices with the last bend leftmost."""
    rng = np.random.default_rng(5)
    history, told = History(), []
    for step in range(9):
        pose = rng.normal(size=(1, 3))
        history.add(pose, np.empty((0, 1), dtype=np.int32))
        told.append(matrix(pose[0]))
        if step in (3, 5, 8):
            bend = rng.normal(size=(step + 1, 3))
            history.bent(bend)
            told = [matrix(T) @ pose for T, pose in zip(bend, told, strict=True)]
    found = np.array([matrix(pose) for pose in history.path(0)])
    np.testing.assert_allclose(found, told, atol=1e-12)
