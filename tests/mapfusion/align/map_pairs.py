"""Synthetic pairs of maps that share a part of their world."""

from dataclasses import dataclass, replace

import numpy as np

from mapfusion.align.correspondences import Correspondences
from mapfusion.descriptors import USURF
from mapfusion.geometry import se2
from mapfusion.landmark_map import LandmarkMap

SIZE_M = np.array([20.0, 20.0, 2.5])


@dataclass(frozen=True)
class MapPair:
    """Two maps, the true motion between them, and correspondences marked by `is_true`."""

    map_a: LandmarkMap
    map_b: LandmarkMap
    T_a_b: np.ndarray
    correspondences: Correspondences
    is_true: np.ndarray


def landmarks(position_m, sigma_m=0.05, descriptor=None, label=None, planar=False, name="map"):
    """Return a map with isotropic covariances."""
    n = len(position_m)
    covariance = np.tile(np.eye(3) * sigma_m**2, (n, 1, 1))
    if planar:
        covariance[:, 2] = covariance[:, :, 2] = 0.0
    return LandmarkMap(
        np.asarray(position_m, dtype=float),
        covariance,
        np.full(n, 5, np.int32),
        np.arange(n),
        descriptor,
        label,
        planar,
        name,
    )


def motion(rng):
    """Return a random motion of the plane."""
    return np.array([*rng.uniform(-10, 10, 2), rng.uniform(-np.pi, np.pi)])


def unit_vectors(rng, n):
    vectors = rng.standard_normal((n, USURF.length))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def given_pairs(rng, n=100, true_share=1.0, sigma_m=0.0, drift_m=0.0, T_a_b=None, planar=False):
    """Return pairs of uniform points with noise in map b; false pairs are uniform."""
    T_a_b = motion(rng) if T_a_b is None else T_a_b
    n_true = round(true_share * n)
    p_a = rng.uniform(0, SIZE_M, (n, 3))
    p_b = se2.transform_points(se2.inverse(T_a_b), p_a)
    p_b += rng.normal(0, sigma_m, (n, 3)) + rng.normal(0, drift_m, (n, 3)) * [1, 1, 0]
    others = rng.uniform(0, SIZE_M, (n, 3))
    p_b[n_true:] = se2.transform_points(se2.inverse(T_a_b), others)[n_true:]
    if planar:
        p_a[:, 2] = p_b[:, 2] = 0
    order = rng.permutation(n)
    is_true = np.zeros(n, dtype=bool)
    is_true[order[:n_true]] = True
    shuffled_b = np.empty_like(p_b)
    shuffled_b[order] = p_b
    shuffled_a = np.empty_like(p_a)
    shuffled_a[order] = p_a
    return MapPair(
        landmarks(shuffled_a, 0.0, planar=planar, name="a"),
        landmarks(shuffled_b, sigma_m, planar=planar, name="b"),
        T_a_b,
        Correspondences(np.arange(n), np.arange(n), rng.uniform(0, 0.3, n)),
        is_true,
    )


def error(T_estimated, T_a_b):
    """Return the translation error (m) and the rotation error (rad)."""
    return (
        float(np.hypot(*(T_estimated - T_a_b)[:2])),
        abs(float(se2.wrap(T_estimated[2] - T_a_b[2]))),
    )


def swapped(pair):
    """Return the same pairs with the maps exchanged."""
    c = pair.correspondences
    return MapPair(
        pair.map_b,
        pair.map_a,
        se2.inverse(pair.T_a_b),
        Correspondences(c.index_b, c.index_a, c.distance),
        pair.is_true,
    )


def moved(landmark_map, T_new_old):
    """Return a map in another frame."""
    return replace(
        landmark_map,
        position_m=se2.transform_points(T_new_old, landmark_map.position_m),
        covariance_m2=se2.transform_covariances(T_new_old, landmark_map.covariance_m2),
    )


def stretched(rng, landmark_map, ratio=4.0):
    """Return the map with covariances of random direction and an axis ratio of `ratio`."""
    n = len(landmark_map)
    turn = se2.rotation(rng.uniform(-np.pi, np.pi, n))
    covariance = landmark_map.covariance_m2.copy()
    sigma2 = covariance[:, :1, :1]
    long = turn @ np.diag([ratio**2, 1.0]) @ np.swapaxes(turn, 1, 2)
    covariance[:, :2, :2] = sigma2 * long
    return replace(landmark_map, covariance_m2=covariance)


def blurred(rng, n, true_share=0.3, sigma_m=0.05):
    """Return planar pairs with noise of random anisotropic covariances in both maps."""
    pair = given_pairs(rng, n, true_share, planar=True)
    maps = []
    for landmarks in (pair.map_a, pair.map_b):
        covariance = landmarks.covariance_m2.copy()
        sigma = sigma_m * rng.uniform(0.2, 1.5, n)
        covariance[:, :2, :2] = np.eye(2) * sigma[:, None, None] ** 2
        known = stretched(rng, replace(landmarks, covariance_m2=covariance))
        root = np.linalg.cholesky(known.covariance_m2[:, :2, :2])
        position = known.position_m.copy()
        position[:, :2] += (root @ rng.standard_normal((n, 2, 1)))[:, :, 0]
        maps.append(replace(known, position_m=position))
    return maps, pair


def covariances(rng, n, dimensions=3):
    """Return random covariances of about (0.1 m)^2, shape (n, d, d)."""
    root = rng.normal(0, 0.1, (n, dimensions, dimensions))
    return root @ np.swapaxes(root, 1, 2) + 1e-4 * np.eye(dimensions)
