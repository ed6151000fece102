"""Whether landmarks span enough, against the definition in products of whole arrays."""

import numpy as np
import pytest
from scipy.stats import chi2

from mapfusion.align.degeneracy import SHAPE_FALSE_ALARM, lacks_extent
from tests.mapfusion.align.map_pairs import covariances


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
