"""Simulated boulder fields: two maps without descriptors and labels that share some boulders."""

import math
from dataclasses import dataclass, replace

import numpy as np

from mapfusion.geometry.se2 import inverse, transform_points
from mapfusion.landmark_map import LandmarkMap
from tests.mapfusion.align.map_pairs import landmarks


@dataclass(frozen=True)
class Field:
    """Two maps of a field, the true motion, and the true pairs as rows (K, 2)."""

    map_a: LandmarkMap
    map_b: LandmarkMap
    T_a_b: np.ndarray
    true_pairs: np.ndarray

    def share_of_true(self, index_a, index_b) -> float:
        """Return the share of true pairs among the given pairs."""
        known = {tuple(pair) for pair in self.true_pairs.tolist()}
        given = list(zip(index_a.tolist(), index_b.tolist(), strict=True))
        return sum(pair in known for pair in given) / max(len(given), 1)


def made_field(rng, n, n_common, density=0.3, noise_m=0.015, planar=False, up_m=0.0, sizes=False):
    """Return maps of n boulders each, `n_common` of which are in both.

    Boulders are uniform over a square. Heights are those of gentle hills. `up_m` is the height of
    frame b in frame a. Sizes are lognormal and measured to 3 %.
    """
    side_m = math.sqrt(n / density)
    world = rng.uniform(0, side_m, (2 * n - n_common, 3))
    world[:, 2] = np.sin(world[:, 0] / 5) * np.cos(world[:, 1] / 4) + rng.normal(0, 0.1, len(world))
    size_m = 0.3 * np.exp(rng.normal(0, 0.5, len(world)))
    T_a_b = np.array([*rng.uniform(-30, 30, 2), rng.uniform(-math.pi, math.pi)])
    order_b = rng.permutation(n) + n - n_common
    rows = np.arange(n), order_b
    maps = []
    for name, own in zip("ab", rows, strict=True):
        p = world[own] + rng.normal(0, noise_m, (n, 3))
        if name == "b":
            p[:, :2] = transform_points(inverse(T_a_b), p[:, :2])
            p[:, 2] -= up_m
        if planar:
            p[:, 2] = 0.0
        made = landmarks(p, max(noise_m, 0.01), planar=planar, name=name)
        measured = size_m[own] * (1 + rng.normal(0, 0.03, n))
        maps.append(replace(made, size_m=measured if sizes else None))
    at_b = np.flatnonzero(order_b < n)
    return Field(maps[0], maps[1], T_a_b, np.column_stack([order_b[at_b], at_b]))


def mirrored(landmarks: LandmarkMap) -> LandmarkMap:
    """Return the mirror image of a map."""
    flip = np.array([1.0, -1.0, 1.0])
    covariance = landmarks.covariance_m2 * np.outer(flip, flip)
    return replace(landmarks, position_m=landmarks.position_m * flip, covariance_m2=covariance)
