"""Whether a map has the landmarks that must be in it."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mapfusion.align.closest import Grid, runs_about
from mapfusion.se2 import Float


class Looks(NamedTuple):
    """N landmarks by place and look, for the kernel.

    Attributes:
        near: the grid over their places in the plane.
        z_m: (N,) heights.
        z_m2: (N,) their variances.
        descriptor: (N, D) float32.
    """

    near: Grid
    z_m: Float
    z_m2: Float
    descriptor: np.ndarray


class Gates(NamedTuple):
    """How far off what is the same may be.

    Attributes:
        distance_m: in the plane.
        height_bound: of the squared difference of heights, over its variance; infinite where
            heights tell nothing.
        height_floor_m2: of that variance, what landmarks' own leave out.
        unlike: of descriptors.
    """

    distance_m: float
    height_bound: float
    height_floor_m2: float
    unlike: float


@njit(cache=True)
def has(p: Float, rows: np.ndarray, own: Looks, other: Looks, gates: Gates) -> np.ndarray:
    """Bool (n,): whether `other` has some `rows` (n,) of `own`, whose places are p (N, 3) there."""
    found = np.zeros(len(rows), np.bool_)
    runs = np.empty((other.near.shape[1], 2), np.int64)
    for m in range(len(rows)):
        i = rows[m]
        for run in range(runs_about(p[i, 0], p[i, 1], gates.distance_m, other.near, runs)):
            for k in range(runs[run, 0], runs[run, 1]):
                if found[m]:
                    break
                dx, dy = other.near.p[k, 0] - p[i, 0], other.near.p[k, 1] - p[i, 1]
                if dx * dx + dy * dy > gates.distance_m * gates.distance_m:
                    continue
                found[m] = _alike(own, i, other, other.near.row[k], gates)
    return found


@njit(cache=True)
def _alike(own: Looks, i: int, other: Looks, j: int, gates: Gates) -> bool:
    """Whether landmarks i and j may have one height and look the same; False for NaN."""
    dz = own.z_m[i] - other.z_m[j]
    variance = own.z_m2[i] + other.z_m2[j] + gates.height_floor_m2
    if gates.height_bound < math.inf and dz * dz > gates.height_bound * variance:
        return False
    square = 0.0
    for d in range(own.descriptor.shape[1]):
        square += (own.descriptor[i, d] - other.descriptor[j, d]) ** 2
    return square <= gates.unlike * gates.unlike
