"""Whether landmarks span enough, against the definition in products of whole arrays."""

import numpy as np
import pytest
from scipy.stats import chi2

from mapfusion.align.correspondences import Correspondences
from mapfusion.align.degeneracy import SHAPE_FALSE_ALARM, lacks_extent, why_one_place
from mapfusion.align.pairs import Pairs
from tests.mapfusion.align.map_pairs import covariances, landmarks


def slow_share(p, covariance, drift_m2, dimensions):
    """The spread along the axis in question over the most that noise gives."""
    plan = p[:, :2] - p[:, :2].mean(axis=0)
    _, sizes, axes = np.linalg.svd(plan)
    axis = axes[dimensions - 1]
    noise = axis @ (covariance[:, :2, :2].mean(axis=0) + drift_m2 * np.eye(2)) @ axis
    return sizes[dimensions - 1] ** 2 / noise / chi2.ppf(1 - SHAPE_FALSE_ALARM, len(p) - dimensions)


@pytest.mark.parametrize("dimensions", [1, 2])
@pytest.mark.parametrize("drift_m2", [0.0, 0.04])
def test_decides_as_the_definition_does(dimensions, drift_m2):
    """Of the same shape just too small and just large enough, far from the origin."""
    rng = np.random.default_rng(0)
    for n in (3, 5, 200):
        covariance = covariances(rng, n)
        away = rng.uniform(-50, 50, 3)
        p = rng.standard_normal((n, 3)) * [3.0, 1.0, 7.0]
        p[:, :2] *= slow_share(p, covariance, drift_m2, dimensions) ** -0.5
        assert lacks_extent(0.999 * p + away, covariance, drift_m2, dimensions)
        assert not lacks_extent(1.001 * p + away, covariance, drift_m2, dimensions)


@pytest.mark.parametrize("dimensions", [1, 2])
def test_points_without_noise_have_the_extent_that_rounding_leaves(dimensions):
    p = np.full((50, 2), 1e3) + np.array([[1e-14, 1e-14]]) * np.arange(50)[:, None]
    assert lacks_extent(p, np.zeros((50, 2, 2)), 0.0, dimensions)
    p[0, 0] += 1e-3
    assert not lacks_extent(p, np.zeros((50, 2, 2)), 0.0, 1)


@pytest.mark.parametrize("at_one_point", ["a", "b"])
def test_either_map_at_one_point_leaves_the_angle_open(at_one_point):
    p = np.random.default_rng(1).uniform(0, 9, (20, 3))
    maps = {name: landmarks(p, name=name) for name in "ab"}
    assert why_one_place(pairs_of(maps)) == ""
    maps[at_one_point] = landmarks(np.tile(p[:1], (20, 1)), name=at_one_point)
    assert f"map {at_one_point}" in why_one_place(pairs_of(maps))


def pairs_of(maps):
    each = np.arange(20)
    return Pairs(maps["a"], maps["b"], Correspondences(each, each, np.zeros(20)))
