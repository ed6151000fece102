"""What can come within a gate, against all pairs."""

import numpy as np

from mapfusion.align.mahalanobis_gate import (
    PlanarPairs,
    farthest_m,
    leaves_margin,
    rows_in_reach,
    those_of,
)
from mapfusion.geometry import se2
from tests.helpers.inner_kernels import from_python


def test_whatever_comes_within_the_gate_before_the_margin_is_left_is_among_the_rows() -> None:
    rng, gate_m, looked_at, left = np.random.default_rng(0), 0.5, 0, 0
    for _ in range(200):
        p_b = rng.uniform(-4, 4, (300, 2))
        before = np.array([*rng.uniform(-5, 5, 2), rng.uniform(-3, 3)])
        p_a = se2.transform_points(before, p_b) + rng.normal(0, 0.6, (300, 2))
        S = rng.standard_normal((2, 300, 2, 2))
        pairs, also = PlanarPairs(p_a, p_b, *S), rng.random(300) < 0.1
        rows = rows_in_reach(before, pairs, gate_m, also)
        assert np.isin(np.flatnonzero(also), rows).all()
        assert len(rows) < 250
        for part, some in zip(pairs, those_of(pairs, rows), strict=True):
            np.testing.assert_array_equal(some, part[rows])
        after = before + rng.normal(0, 1, 3) * [0.05, 0.05, 0.012]
        if leaves_margin(after, before, gate_m, from_python(farthest_m)(p_b)):
            left += 1
            continue
        inside = np.linalg.norm(p_a - se2.transform_points(after, p_b), axis=1) <= gate_m
        looked_at += np.sum(inside)
        assert np.isin(np.flatnonzero(inside), rows).all()
    assert looked_at > 1000
    assert left > 20
