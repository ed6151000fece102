"""Tests of `mapfusion.fastslam.particles`."""

import numpy as np
import pytest

from mapfusion.fastslam.landmark_arrays import BLOCK, FREE, allocate, slots_near
from mapfusion.fastslam.measurement import DROPPED, NEW, observations_in_map
from mapfusion.fastslam.particles import ParticleMaps, PathHistory
from mapfusion.fastslam.resampling import MEMORY
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import Observations


def lives(n_particles: int, n_steps: int, resampled_every: int) -> tuple[PathHistory, list]:
    """Return a history of random steps, and the expected path and associations per particle."""
    rng = np.random.default_rng(3)
    history = PathHistory()
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
            history.resample(ancestors)
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
    """Return the homogeneous matrix (3, 3) of a pose or motion of the plane."""
    x, y, angle = T
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, x], [sin, cos, y], [0, 0, 1]])


def test_each_bend_moves_the_path_as_the_bends_before_left_it() -> None:
    """The path equals a product of matrices with the last bend leftmost."""
    rng = np.random.default_rng(5)
    history, told = PathHistory(), []
    for step in range(9):
        pose = rng.normal(size=(1, 3))
        history.add(pose, np.empty((0, 1), dtype=np.int32))
        told.append(matrix(pose[0]))
        if step in (3, 5, 8):
            bend = rng.normal(size=(step + 1, 3))
            history.correct(bend)
            told = [matrix(T) @ pose for T, pose in zip(bend, told, strict=True)]
    found = np.array([matrix(pose) for pose in history.path(0)])
    np.testing.assert_allclose(found, told, atol=1e-12)


def test_near_finds_the_gates_that_touch_a_box_and_no_freed_slot():
    rng = np.random.default_rng(0)
    n, sigma_m, gate = 400, 0.1, 9.0  # more than there is room for at first
    observations = Observations(
        rng.uniform(-20, 20, (n, 3)), np.tile(sigma_m**2 * np.eye(3), (n, 1, 1))
    )
    seen = observations_in_map(
        np.zeros((2, 3)), observations.position_m, observations.covariance_m2, planar=False
    )
    chosen = np.full((n, 2), NEW)
    chosen[2::3, 0] = DROPPED  # the second particle alone has these, the sixth landmark among them
    maps = ParticleMaps(2, gate)
    slots, rows = maps.create(chosen, seen, observations, 0)
    assert rows.tolist() == list(range(n))

    def assert_found(held: np.ndarray) -> None:
        reach_m = sigma_m * np.sqrt(gate)
        low, high = (observations.position_m[:, :2] + side * reach_m for side in (-1, 1))
        for _ in range(50):
            corner = rng.uniform(-25, 25, 2)
            box = np.concatenate([corner, corner + 10.0 ** rng.uniform(-3, 1.5, 2)])
            touches = np.all((low <= box[2:]) & (high >= box[:2]), axis=1)
            assert slots_near(maps.slots, box).tolist() == sorted(slots[touches & held].tolist())

    assert_found(np.ones(n, dtype=bool))
    maps.resample(np.array([0, 0], dtype=np.int32))
    maps.bring_up_to_date(slots[maps.slots.generation[slots] != FREE])  # some were visited
    left = np.arange(n) % 3 != 2
    assert maps.n_slots == left.sum()
    assert_found(left)


def test_what_all_particles_have_from_one_ancestor_is_kept_once_and_comes_back():
    """Landmarks that differ between particles, then all descend from the third particle."""
    n, n_particles = 300, 4  # more than there are rows for at first
    rng = np.random.default_rng(1)
    observations = Observations(rng.uniform(-5, 5, (n, 3)), np.tile(0.01 * np.eye(3), (n, 1, 1)))
    poses = rng.normal(0, 0.5, (n_particles, 3))
    seen = observations_in_map(
        poses, observations.position_m, observations.covariance_m2, planar=False
    )
    maps = ParticleMaps(n_particles, 9.0)
    slots, _ = maps.create(np.full((n, n_particles), NEW), seen, observations, 0)
    ancestors = np.arange(n_particles, dtype=np.int32)
    for _ in range(2 * MEMORY):
        maps.resample(ancestors)
    assert maps.n_rows == n, "particles differ, however long ago they were written"
    maps.resample(np.full(n_particles, 2, dtype=np.int32))
    for _ in range(MEMORY):
        maps.resample(ancestors)
    assert (maps.n_slots, maps.n_rows) == (n, 0)

    def assert_known(particle: int) -> None:
        which, known = maps.landmarks_of(particle, 1)
        np.testing.assert_array_equal(which, slots)
        np.testing.assert_array_equal(known.mean_m, seen.point_m[:, 2])
        np.testing.assert_array_equal(known.covariance_m2, seen.covariance_m2[:, 2])
        assert known.count.tolist() == [1] * n

    assert_known(0)
    box = np.array([*seen.point_m[7, 2, :2], *seen.point_m[7, 2, :2]])
    assert slots[7] in slots_near(maps.slots, box)
    assert maps.bring_up_to_date(slots[::2]).all()
    assert maps.n_rows == n // 2
    assert_known(1)


def test_a_landmark_takes_a_row_of_76_bytes_a_particle_and_less_than_500_once():
    n_slots, n_rows, n_particles = 4 * BLOCK, 10, 200
    slots = allocate(n_slots, n_rows, n_particles)
    of_rows = [*slots.by_particle, slots.slot_of_row]
    of_slots = [*slots.common, *slots[3:]]
    assert sum(part.nbytes for part in of_rows) == n_rows * (76 * n_particles + 8)
    assert sum(part.nbytes for part in of_slots) < 500 * n_slots


def test_without_landmarks_nothing_is_near():
    assert len(slots_near(ParticleMaps(2, 9.0).slots, np.array([-1.0, -1, 1, 1]))) == 0


def shared_past(n: int, n_particles: int, n_steps: int) -> tuple[PathHistory, list, int]:
    """Return particles with a shared past of n steps, and the expected lives of all of them."""
    rng = np.random.default_rng(n)
    path = rng.normal(size=(n, 3))
    sources = [rng.integers(-1, 100, rng.integers(4)) for _ in range(n)]
    history = PathHistory.of_path(path, sources, n_particles)
    shared = list(path), np.concatenate(sources).tolist()
    told: list = [(list(shared[0]), list(shared[1])) for _ in range(n_particles)]
    n_last = len(sources[-1])
    for step in range(n_steps):
        poses = rng.normal(size=(n_particles, 3))
        source = rng.integers(-1, 100, (rng.integers(4), n_particles), dtype=np.int32)
        history.add(poses, source)
        n_last = len(source)
        for m, (own_path, associations) in enumerate(told):
            own_path.append(poses[m])
            associations.extend(source[:, m])
        if step % 5 == 0:
            ancestors = np.sort(rng.integers(n_particles, size=n_particles)).astype(np.int32)
            history.resample(ancestors)
            told = [(list(told[a][0]), list(told[a][1])) for a in ancestors]
    return history, told, n_last


@pytest.mark.parametrize("n_steps", [0, 1, 256, 900])
@pytest.mark.parametrize("n", [1, 40])
def test_particles_go_on_from_a_shared_past(n: int, n_steps: int) -> None:
    history, told, n_last = shared_past(n, 5, n_steps)
    for m, (path, associations) in enumerate(told):
        np.testing.assert_array_equal(history.path(m), path)
        assert history.associations(m).tolist() == associations
        last = history.last_associations(m)
        assert last.tolist() == associations[len(associations) - n_last :]
    assert history.n_kept < n + n_steps + 5 * 257


def test_a_shared_past_is_corrected() -> None:
    rng = np.random.default_rng(0)
    path, by = rng.normal(size=(4, 3)), rng.normal(size=(5, 3))
    history = PathHistory.of_path(path, [np.empty(0, dtype=np.int64)] * 4, 3)
    poses = rng.normal(size=(3, 3))
    history.add(poses, np.empty((0, 3), dtype=np.int32))
    history.correct(by)
    for m in range(3):
        expected = [matrix(T) @ matrix(own) for T, own in zip(by, [*path, poses[m]], strict=True)]
        found = np.array([matrix(pose) for pose in history.path(m)])
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_landmarks_that_all_particles_share_take_no_rows_until_they_are_needed() -> None:
    """More than there are slots for at first; a landmark of one particle alone was there before."""
    rng, n, n_particles = np.random.default_rng(4), 5 * BLOCK, 3
    root = rng.normal(0, 0.1, (n, 3, 3))
    given = LandmarkMap(
        rng.uniform(-20, 20, (n, 3)),
        root @ root.transpose(0, 2, 1) + 1e-6 * np.eye(3),
        rng.integers(1, 9, n).astype(np.int32),
        np.arange(n),
        rng.normal(size=(n, 8)).astype(np.float32),
        rng.integers(0, 99, n).astype(np.int32),
    )
    maps = ParticleMaps(n_particles, 9.0)
    first = Observations(np.array([[1.0, 2, 3]]), np.eye(3)[None])
    seen = observations_in_map(
        np.zeros((n_particles, 3)), first.position_m, first.covariance_m2, planar=False
    )
    maps.create(np.array([[NEW, DROPPED, DROPPED]]), seen, first, 7)
    source, last_frame = 1000 + np.arange(n), rng.integers(-50, 50, n)
    slots = maps.add_common(given, source, last_frame)
    assert (maps.n_slots, maps.n_rows) == (n + 1, 1)
    assert maps.n_landmarks.tolist() == [n + 1, n, n]

    def assert_known(particle: int) -> None:
        which, known = maps.landmarks_of(particle, 1)
        known = type(known)(*(values[-n:] for values in known))
        np.testing.assert_array_equal(which[-n:], slots)
        np.testing.assert_array_equal(known.mean_m, given.position_m)
        np.testing.assert_array_equal(
            known.covariance_m2, given.covariance_m2[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        )
        np.testing.assert_array_equal(known.count, given.count)

    for name in ("descriptor", "label"):
        np.testing.assert_array_equal(getattr(maps.slots, name)[slots], getattr(given, name))
    np.testing.assert_array_equal(maps.slots.source[slots], source)
    np.testing.assert_array_equal(maps.slots.last_frame[slots], last_frame)
    assert_known(0)
    for k in range(0, n, 7):
        at = given.position_m[k, :2]
        assert slots[k] in slots_near(maps.slots, np.array([*at, *at]))
    assert maps.bring_up_to_date(slots[::2]).all()
    assert maps.n_rows == 1 + len(slots[::2])
    maps.resample(np.array([2, 0, 0], dtype=np.int32))
    for particle in range(n_particles):
        assert_known(particle)
