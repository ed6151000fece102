"""Near landmarks of a map: a grid over the plane, looked at about a point."""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.kernels import inner_kernel, kernel
from mapfusion.se2 import Float

_WIDER = 1 + 1e-6  # than the radius asked for, so that rounding leaves out no point on its edge
_LANDMARKS_PER_CELL = 2.0  # on average; few enough to look at all, enough to skip empty space


class Grid(NamedTuple):
    """N points sorted into square cells of the plane, for the kernels.

    Attributes:
        p: (N, 2 or 3) the points, cell by cell.
        row: (N,) where each was in the array given.
        start: (nx ny + 1,) first point of each cell.
        corner_m: (2,) lower corner of the first cell.
        cell_m: side of a cell.
        shape: (2,) cells along x and y.
    """

    p: Float
    row: np.ndarray
    start: np.ndarray
    corner_m: Float
    cell_m: float
    shape: np.ndarray

    @classmethod
    def of(cls, p: Float) -> "Grid":
        """Grid over points (N, 2 or 3)."""
        return _sorted_into_cells(np.ascontiguousarray(p))


@kernel
def _sorted_into_cells(p: Float) -> Grid:
    n = len(p)
    corner_m, extent_m = np.zeros(2), np.zeros(2)
    for axis in range(2):
        low, high = math.inf, -math.inf
        for i in range(n):
            low, high = min(low, p[i, axis]), max(high, p[i, axis])
        if n > 0:
            corner_m[axis], extent_m[axis] = low, high - low
    cell_m = 1.0
    if extent_m[0] > 0 or extent_m[1] > 0:
        # a line or a point has no area; cells as long as its share of the longer side do
        area = extent_m[0] * extent_m[1]
        cell_m = max(math.sqrt(area * _LANDMARKS_PER_CELL / n), max(extent_m[0], extent_m[1]) / n)
    nx, ny = int(extent_m[0] / cell_m) + 1, int(extent_m[1] / cell_m) + 1
    cell, start = np.empty(n, np.int64), np.zeros(nx * ny + 1, np.int64)
    for i in range(n):
        x, y = int((p[i, 0] - corner_m[0]) / cell_m), int((p[i, 1] - corner_m[1]) / cell_m)
        cell[i] = y * nx + x
        start[cell[i] + 1] += 1
    for k in range(nx * ny):
        start[k + 1] += start[k]
    next_free = start.copy()
    sorted_p, row = np.empty_like(p), np.empty(n, np.int64)
    for i in range(n):
        k = next_free[cell[i]]
        next_free[cell[i]] += 1
        row[k] = i
        for axis in range(p.shape[1]):
            sorted_p[k, axis] = p[i, axis]
    return Grid(sorted_p, row, start, corner_m, cell_m, np.array([nx, ny]))


@inner_kernel
def _cells(middle: float, radius: float, corner: float, cell: float, cells: int) -> tuple[int, int]:
    """First cell that an interval meets along one axis, and one behind the last."""
    wider = radius * _WIDER
    first = max(math.floor((middle - wider - corner) / cell), 0.0)
    last = min(math.floor((middle + wider - corner) / cell), cells - 1.0)
    return (int(first), int(last) + 1) if first <= last else (0, 0)


@inner_kernel
def runs_about(x: float, y: float, radius_m: float, grid: Grid, runs: np.ndarray) -> int:
    """Ranges of grid.p with all points within a radius of (x, y), and others.

    They go into `runs` (ny, 2), first and one behind the last of each; returns how many.
    """
    nx, ny = grid.shape[0], grid.shape[1]
    left, right = _cells(x, radius_m, grid.corner_m[0], grid.cell_m, nx)
    low, high = _cells(y, radius_m, grid.corner_m[1], grid.cell_m, ny)
    if left == right:
        return 0
    for row in range(low, high):
        runs[row - low, 0] = grid.start[row * nx + left]
        runs[row - low, 1] = grid.start[row * nx + right]
    return high - low
