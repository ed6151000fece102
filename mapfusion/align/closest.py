"""Near landmarks of a map: a grid over the plane, looked at about a point."""

import math
from typing import NamedTuple

import numpy as np

from mapfusion.kernels import inner_kernel
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
        n, (x, y) = len(p), np.ascontiguousarray(p[:, :2].T)
        corner_m, extent_m, cell_m = np.zeros(2), np.zeros(2), 1.0
        if n:
            corner_m = np.array([x.min(), y.min()])
            extent_m = np.array([x.max(), y.max()]) - corner_m
        if extent_m.any():
            # a line or a point has no area; cells as long as its share of the longer side do
            area = extent_m[0] * extent_m[1]
            cell_m = max(math.sqrt(area * _LANDMARKS_PER_CELL / n), float(extent_m.max()) / n)
        shape = (extent_m / cell_m).astype(np.int64) + 1
        column = ((x - corner_m[0]) / cell_m).astype(np.int64)
        cell = ((y - corner_m[1]) / cell_m).astype(np.int64) * shape[0] + column
        # of short numbers NumPy sorts by digits
        row = np.argsort(cell.astype(np.min_scalar_type(shape[0] * shape[1])), kind="stable")
        start = np.zeros(shape[0] * shape[1] + 1, np.int64)
        np.cumsum(np.bincount(cell, minlength=len(start) - 1), out=start[1:])
        return cls(p[row], row, start, corner_m, cell_m, shape)


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
