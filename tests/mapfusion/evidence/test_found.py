"""Whether a map has a landmark, against all pairs one by one."""

import numpy as np
import pytest

from mapfusion.align.nearest_neighbours import Grid
from mapfusion.verification.regions import Gates, Looks, has


def looks(rng: np.random.Generator, p: np.ndarray) -> Looks:
    descriptor = rng.integers(0, 3, (len(p), 8)).astype(np.float32)
    z_m2 = rng.uniform(0, 0.01, len(p))
    return Looks(Grid.of(p[:, :2]), p[:, 2].copy(), z_m2, descriptor)


@pytest.mark.parametrize("bound", [4.0, np.inf])
def test_equals_all_pairs(bound: float) -> None:
    rng = np.random.default_rng(0)
    p, q = rng.uniform(0, 3, (200, 3)), rng.uniform(0, 3, (300, 3))
    own, other = looks(rng, p), looks(rng, q)
    rows, gates = np.arange(0, 200, 3), Gates(0.5, bound, 0.01, 2.0)
    near = np.linalg.norm(p[rows][:, None, :2] - q[None, :, :2], axis=2) <= 0.5
    dz2 = (p[rows][:, None, 2] - q[None, :, 2]) ** 2
    level = dz2 <= bound * (own.z_m2[rows][:, None] + other.z_m2 + 0.01)
    unlike = np.linalg.norm(own.descriptor[rows][:, None] - other.descriptor, axis=2)
    expected = (near & level & (unlike <= 2.0)).any(axis=1)
    found = has(p, rows, own, other, gates)
    np.testing.assert_array_equal(found, expected)
    assert 10 < found.sum() < len(rows) - 5


def test_no_descriptor_is_found_nowhere() -> None:
    p = np.zeros((1, 3))
    own = Looks(Grid.of(p[:, :2]), np.zeros(1), np.ones(1), np.full((1, 8), np.nan, np.float32))
    assert not has(p, np.arange(1), own, own, Gates(1.0, np.inf, 0.0, 9.0)).any()
