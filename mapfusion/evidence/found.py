"""Whether a map has the landmarks that must be in it."""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.align.closest import Grid, runs_about
from mapfusion.kernels import kernel, kernel_part
from mapfusion.se2 import Float

# Of a descriptor's dimensions, those after which it is asked whether the distance is too large yet.
_AT_A_TIME = 8


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


@kernel
def has(p: Float, rows: np.ndarray, own: Looks, other: Looks, gates: Gates) -> np.ndarray:
    """Bool (n,): whether `other` has some `rows` (n,) of `own`, whose places are p (N, 3) there.

    What has no descriptor (NaN) is not found.
    """
    # arrays by themselves: taken from a tuple, each access would count its references
    _, z_own, z2_own, look_own = own
    near, z_other, z2_other, look_other = other
    at, row_of, distance_m = near.p, near.row, gates.distance_m
    found = np.zeros(len(rows), np.bool_)
    runs = np.empty((near.shape[1], 2), np.int64)
    most, floor_m2, unlike2 = gates.height_bound, gates.height_floor_m2, gates.unlike**2
    for m in range(len(rows)):
        i = rows[m]
        for run in range(runs_about(p[i, 0], p[i, 1], distance_m, near, runs)):
            for k in range(runs[run, 0], runs[run, 1]):
                dx, dy = at[k, 0] - p[i, 0], at[k, 1] - p[i, 1]
                if dx * dx + dy * dy > distance_m * distance_m:
                    continue
                j = row_of[k]
                dz = z_own[i] - z_other[j]
                if most < math.inf and dz * dz > most * (z2_own[i] + z2_other[j] + floor_m2):
                    continue
                if _alike(look_own, i, look_other, j, unlike2):
                    found[m] = True
                    break
            if found[m]:
                break
    return found


@kernel_part
def _alike(own: np.ndarray, i: int, other: np.ndarray, j: int, most: float) -> bool:
    """Whether descriptors i and j of (N, D) are no more than so much apart, squared."""
    square = 0.0
    for first in range(0, own.shape[1], _AT_A_TIME):
        for d in range(first, min(first + _AT_A_TIME, own.shape[1])):
            square += (own[i, d] - other[j, d]) ** 2
        if square > most:
            return False
    return square <= most
