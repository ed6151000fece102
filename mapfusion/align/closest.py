"""The nearest landmark of a map: a grid over the plane, searched ring by ring."""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from mapfusion.se2 import Float

_LANDMARKS_PER_CELL = 2.0  # on average; few enough to look at all, enough to skip empty space


class Grid(NamedTuple):
    """N points sorted into square cells of the plane, for the kernels.

    Attributes:
        p: (N, 3) the points, cell by cell.
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
        """Grid over points (N, 3), N at least 1."""
        corner = p[:, :2].min(axis=0)
        extent = p[:, :2].max(axis=0) - corner
        # a line or a point has no area; cells as long as its share of the longer side do
        side = max(math.sqrt(extent.prod() * _LANDMARKS_PER_CELL / len(p)), extent.max() / len(p))
        cell = side if side > 0 else 1.0
        shape = (extent / cell).astype(np.int64) + 1
        at = ((p[:, :2] - corner) / cell).astype(np.int64)
        flat = at[:, 1] * shape[0] + at[:, 0]
        row = np.argsort(flat, kind="stable")
        start = np.searchsorted(flat[row], np.arange(shape.prod() + 1))
        return cls(np.ascontiguousarray(p[row]), row, start, corner, cell, shape)


@njit(cache=True)
def nearest_two(qx: float, qy: float, qz: float, grid: Grid) -> tuple[int, float, float]:
    """Index into grid.p of the point nearest to q, its distance, and that of the next one.

    The last is infinite when there is one point only.
    """
    p, start, corner_m, cell_m = grid.p, grid.start, grid.corner_m, grid.cell_m
    at_x = math.floor((qx - corner_m[0]) / cell_m)
    at_y = math.floor((qy - corner_m[1]) / cell_m)
    nx, ny = grid.shape[0], grid.shape[1]
    first, square1, square2 = -1, math.inf, math.inf
    ring = max(0, -at_x, at_x - nx + 1, -at_y, at_y - ny + 1)  # the first that meets the grid
    last = max(at_x, nx - 1 - at_x, at_y, ny - 1 - at_y)
    while ring <= last:
        # whatever lies in this ring or beyond is at least ring - 1 whole cells away
        if ring > 0 and square2 <= ((ring - 1) * cell_m) ** 2:
            break
        for y in range(max(at_y - ring, 0), min(at_y + ring, ny - 1) + 1):
            inner = abs(y - at_y) < ring
            step = 2 * ring if inner else 1
            x = at_x - ring
            if x < 0:
                x = at_x + ring if inner else 0
            while x <= min(at_x + ring, nx - 1):
                cell = y * nx + x
                for k in range(start[cell], start[cell + 1]):
                    dx, dy, dz = p[k, 0] - qx, p[k, 1] - qy, p[k, 2] - qz
                    square = dx * dx + dy * dy + dz * dz
                    if square < square1:
                        first, square1, square2 = k, square, square1
                    elif square < square2:
                        square2 = square
                x += step
        ring += 1
    return first, math.sqrt(square1), math.sqrt(square2)
