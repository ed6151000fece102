import numpy as np
import pytest
from scipy.spatial.distance import cdist

from mapfusion.align.closest import Grid, nearest_two, runs_about


def points(kind, rng):
    return {
        "spread": rng.uniform(0, 20, (300, 3)),
        "one wall": np.column_stack([np.full(200, 3.0), rng.uniform(0, 15, 200), np.zeros(200)]),
        "far outlier": np.vstack([rng.uniform(0, 5, (200, 3)), [[500.0, -300.0, 1.0]]]),
        "one place": np.ones((40, 3)),
        "two": rng.uniform(0, 1, (2, 3)),
    }[kind]


@pytest.mark.parametrize("kind", ["spread", "one wall", "far outlier", "one place", "two"])
def test_finds_what_looking_at_all_finds(kind):
    rng = np.random.default_rng(0)
    p = points(kind, rng)
    grid = Grid.of(p)
    queries = np.vstack([rng.uniform(-2, 22, (300, 3)), rng.uniform(-100, 100, (50, 3)), p[:20]])
    all_distances = cdist(queries, p)
    two = np.sort(all_distances, axis=1)[:, :2]
    for q, distances, (d1, d2) in zip(queries, all_distances, two, strict=True):
        k, first, second = nearest_two(*q, grid)
        assert (first, second) == pytest.approx((d1, d2), abs=1e-12)
        assert distances[grid.row[k]] == pytest.approx(d1, abs=1e-12)


def test_one_point_has_no_second():
    grid = Grid.of(np.zeros((1, 3)))
    k, first, second = nearest_two(3.0, 4.0, 0.0, grid)
    assert (k, first, second) == (0, 5.0, np.inf)


@pytest.mark.parametrize("kind", ["spread", "one wall", "far outlier", "one place", "two"])
def test_all_within_a_radius_are_in_the_runs_about_a_point(kind):
    rng = np.random.default_rng(1)
    p = points(kind, rng)
    grid, looked_at = Grid.of(p), 0
    runs = np.empty((grid.shape[1], 2), np.int64)
    queries = np.vstack([rng.uniform(-2, 22, (200, 3)), rng.uniform(-1000, 1000, (20, 3)), p[:20]])
    for q, radius in zip(queries, rng.uniform(0, 3, len(queries)), strict=True):
        ranges = runs[: runs_about(q[0], q[1], radius, grid, runs)]
        found = np.concatenate([grid.row[first:end] for first, end in ranges] + [np.zeros(0, int)])
        near = np.flatnonzero(np.hypot(*(p - q)[:, :2].T) <= radius)
        assert len(set(found)) == len(found)
        assert set(near) <= set(found)
        looked_at += len(found)
    assert kind != "spread" or looked_at < 0.2 * len(queries) * len(p)


def test_of_no_points_there_is_a_grid():
    grid = Grid.of(np.zeros((0, 2)))
    runs = np.empty((grid.shape[1], 2), np.int64)
    assert runs_about(0.0, 0.0, 1.0, grid, runs) <= 1
    np.testing.assert_array_equal(grid.start, 0)
