"""Tests of `mapfusion.align.alignment`: extent of landmarks against its definition."""

import numpy as np
import pytest
from scipy.stats import chi2

from mapfusion.align import alignment as module
from mapfusion.align.alignment import SHAPE_FALSE_ALARM, Pairs, lacks_extent, why_angle_is_open
from mapfusion.align.correspondences import Correspondences
from tests.mapfusion.align.map_pairs import covariances, landmarks


def slow_share(p, covariance, drift_m2, dimensions):
    """Return the chi-square of the deviations along an axis over its bound under noise."""
    C = covariance[:, :2, :2] + drift_m2 * np.eye(2)
    weight = np.array([2 / np.trace(S) for S in C])
    plan = p[:, :2] - np.average(p[:, :2], axis=0, weights=weight)
    axis = np.linalg.svd(np.sqrt(weight)[:, None] * plan)[2][dimensions - 1]
    variance = np.array([axis @ S @ axis for S in C])
    along = plan @ axis
    along = along - np.average(along, weights=1 / variance)
    most = chi2.ppf(1 - SHAPE_FALSE_ALARM, len(p) - dimensions)
    return np.sum(along**2 / variance) / most


def test_landmarks_of_one_point_pass_for_a_shape_as_seldom_as_stated(monkeypatch):
    """Landmarks have very different noise."""
    monkeypatch.setattr(module, "SHAPE_FALSE_ALARM", 0.1)
    rng, n, trials = np.random.default_rng(3), 30, 2000
    sigma = np.where(np.arange(n) % 3, 0.01, 0.5)
    covariance = np.zeros((n, 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = sigma**2, 1e-12  # of one axis alone
    shapes = 0
    for _ in range(trials):
        p = np.column_stack([rng.normal(0, sigma), np.zeros(n)])
        shapes += not lacks_extent(p, covariance, 0.0, 1)
    assert shapes / trials == pytest.approx(0.1, abs=0.025)


def test_one_uncertain_landmark_does_not_hide_the_extent_of_the_others():
    rng = np.random.default_rng(0)
    p, covariance = rng.uniform(-6, 6, (40, 2)), np.tile(4e-4 * np.eye(2), (40, 1, 1))
    covariance[7] = 1e10 * np.eye(2)
    for dimensions in (1, 2):
        assert not lacks_extent(p, covariance, 0.0, dimensions)
    covariance[:] = 1e10 * np.eye(2)
    assert lacks_extent(p, covariance, 0.0, 1)


@pytest.mark.parametrize("dimensions", [1, 2])
@pytest.mark.parametrize("drift_m2", [0.0, 0.04])
def test_decides_as_the_definition_does(dimensions, drift_m2):
    """The same shape is tested just below and just above the bound, far from the origin."""
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
    assert why_angle_is_open(pairs_of(maps)) == ""
    maps[at_one_point] = landmarks(np.tile(p[:1], (20, 1)), name=at_one_point)
    assert f"map {at_one_point}" in why_angle_is_open(pairs_of(maps))


def pairs_of(maps):
    each = np.arange(20)
    return Pairs(maps["a"], maps["b"], Correspondences(each, each, np.zeros(20)))
