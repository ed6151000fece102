import numpy as np
import pytest

from mapfusion.align.nearest_neighbours import Grid, runs_about
from tests.helpers.inner_kernels import from_python


def points(kind, rng):
    return {
        "spread": rng.uniform(0, 20, (300, 3)),
        "one wall": np.column_stack([np.full(200, 3.0), rng.uniform(0, 15, 200), np.zeros(200)]),
        "far outlier": np.vstack([rng.uniform(0, 5, (200, 3)), [[500.0, -300.0, 1.0]]]),
        "one place": np.ones((40, 3)),
        "two": rng.uniform(0, 1, (2, 3)),
    }[kind]


@pytest.mark.parametrize("kind", ["spread", "one wall", "far outlier", "one place", "two"])
def test_all_within_a_radius_are_in_the_runs_about_a_point(kind):
    rng = np.random.default_rng(1)
    p = points(kind, rng)
    grid, looked_at = Grid.of(p), 0
    runs = np.empty((grid.shape[1], 2), np.int64)
    queries = np.vstack([rng.uniform(-2, 22, (200, 3)), rng.uniform(-1000, 1000, (20, 3)), p[:20]])
    for q, radius in zip(queries, rng.uniform(0, 3, len(queries)), strict=True):
        ranges = runs[: from_python(runs_about)(q[0], q[1], radius, grid, runs)]
        found = np.concatenate([grid.row[first:end] for first, end in ranges] + [np.zeros(0, int)])
        near = np.flatnonzero(np.hypot(*(p - q)[:, :2].T) <= radius)
        assert len(set(found)) == len(found)
        assert set(near) <= set(found)
        looked_at += len(found)
    assert kind != "spread" or looked_at < 0.2 * len(queries) * len(p)


def test_of_no_points_there_is_a_grid():
    grid = Grid.of(np.zeros((0, 2)))
    runs = np.empty((grid.shape[1], 2), np.int64)
    assert from_python(runs_about)(0.0, 0.0, 1.0, grid, runs) <= 1
    np.testing.assert_array_equal(grid.start, 0)
