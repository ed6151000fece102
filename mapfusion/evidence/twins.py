"""What a map holds twice: landmarks that look like others of the same map, elsewhere."""

import math

import numpy as np

from mapfusion.align.correspondences import Correspondences, HeightGate
from mapfusion.align.nearest_descriptors import nearest_both_ways
from mapfusion.kernels import kernel
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float

# What lies nearer is of one place: neighbouring corners share most of their descriptors' windows,
# and one point may be in a map twice.
_ELSEWHERE_M = 1.0
_UNLIKE = 0.6  # of descriptors, at the most: as landmarks of two maps are paired


def twins(landmarks: LandmarkMap) -> Correspondences:
    """Landmarks that are each other's most alike among those elsewhere, each pair both ways.

    A motion under which such pairs agree lays one part of the map on its like. Maps without
    descriptors have none.
    """
    n = len(landmarks)
    if landmarks.descriptor is None or n < 2:
        return Correspondences(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    height = HeightGate()
    bound = math.inf if landmarks.planar else height.bound
    gates = bound, height.floor_m**2, _ELSEWHERE_M
    nearest, distance2, _ = nearest_both_ways(landmarks, landmarks, *gates)
    rows = np.arange(n)
    unlike = np.sqrt(np.maximum(distance2, 0.0))
    kept = (nearest >= 0) & (nearest[nearest] == rows) & (unlike <= _UNLIKE)
    return Correspondences(rows[kept], nearest[kept], unlike[kept])


@kernel
def largest_patch_m(p: Float, reach_m: float, least: int) -> float:
    """The longest side of the largest patch of points (n, 2), 0 of none.

    Points that are less than `reach_m` apart are of one patch, which has `least` points or more.
    """
    n = len(p)
    patch, queue, longest = np.full(n, -1), np.empty(n, np.int64), 0.0
    for start in range(n):
        if patch[start] >= 0:
            continue
        head, tail = 0, 1
        queue[0], patch[start] = start, start
        low, high = p[start].copy(), p[start].copy()
        while head < tail:
            i = queue[head]
            head += 1
            for axis in range(2):
                low[axis], high[axis] = min(low[axis], p[i, axis]), max(high[axis], p[i, axis])
            for j in range(n):
                dx, dy = p[i, 0] - p[j, 0], p[i, 1] - p[j, 1]
                if patch[j] < 0 and dx * dx + dy * dy < reach_m * reach_m:
                    patch[j] = start
                    queue[tail] = j
                    tail += 1
        if tail >= least:
            longest = max(longest, high[0] - low[0], high[1] - low[1])
    return longest
