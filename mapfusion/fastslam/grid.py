"""Which boxes lie near a box: a hash grid, whose cost depends on what is near, not on all it holds.

A box is kept in one cell: that of its lower corner, on the level whose cells are at least as large
as the box (each level doubles the cell). So it reaches at most into the next cells, and a query
looks one cell further down. Results never depend on the size of the cells, only speed does.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from mapfusion.se2 import Float

_LEVELS = 32
_FREE = -1
# A query's side over the first cell. Landmarks' boxes are small against the view, and this many
# cells on a side are visited in less time than one landmark's update takes.
_CELLS_ON_A_SIDE = 16
# A query that would look at more cells makes the cells larger first.
_MOST_CELLS = 1024


class _Cells(NamedTuple):
    """Buckets of doubly linked boxes."""

    head: np.ndarray  # (B,) first box of a bucket, or _FREE
    following: np.ndarray  # (N,)
    preceding: np.ndarray  # (N,)
    key: np.ndarray  # (N, 3) level, column, row; level is _FREE for a box not held
    population: np.ndarray  # (_LEVELS,) boxes on each level


class Grid:
    """Boxes (min_x, min_y, max_x, max_y) under small integer names.

    `boxes` (N, 4) is the caller's table, read here: a name is a row of it.
    """

    def __init__(self, capacity: int) -> None:
        self._cell_m = 0.0
        self._cells = _empty(capacity)

    def place(self, names: np.ndarray, boxes: Float) -> None:
        """Hold the boxes of `names`, or follow them to where they are now."""
        if len(names) == 0:
            return
        if self._cell_m == 0.0:
            side = np.max(boxes[names, 2:] - boxes[names, :2])
            self._cell_m = float(side) if side > 0 else 1.0
        _place(self._cells, names, boxes, self._cell_m)

    def remove(self, names: np.ndarray) -> None:
        """Hold these no longer."""
        _remove(self._cells, names)

    def near(self, box: Float, boxes: Float) -> np.ndarray:
        """Ascending names of the boxes that touch `box` (4,)."""
        if self._cell_m == 0.0:
            return np.empty(0, dtype=np.int64)
        while _most_cells(self._cells, box, self._cell_m) > _MOST_CELLS:
            side = max(box[2] - box[0], box[3] - box[1]) / _CELLS_ON_A_SIDE
            self._rebuild(max(2 * self._cell_m, side), len(self._cells.following), boxes)
        return np.sort(_near(self._cells, box, boxes, self._cell_m))

    def grow(self, capacity: int, boxes: Float) -> None:
        """Make room for names below `capacity`."""
        self._rebuild(self._cell_m, capacity, boxes)

    def _rebuild(self, cell_m: float, capacity: int, boxes: Float) -> None:
        held = np.flatnonzero(self._cells.key[:, 0] != _FREE)
        self._cell_m = cell_m
        self._cells = _empty(capacity)
        self.place(held, boxes)


def _empty(capacity: int) -> _Cells:
    n_buckets = 2 << int(capacity).bit_length()
    return _Cells(
        np.full(n_buckets, _FREE, dtype=np.int64),
        np.full(capacity, _FREE, dtype=np.int64),
        np.full(capacity, _FREE, dtype=np.int64),
        np.full((capacity, 3), _FREE, dtype=np.int64),
        np.zeros(_LEVELS, dtype=np.int64),
    )


@njit(cache=True)
def _bucket(level: int, column: int, row: int, n_buckets: int) -> int:
    # Large odd multipliers spread neighbouring cells over the buckets (Teschner et al. 2003).
    return ((column * 73856093) ^ (row * 19349663) ^ (level * 83492791)) & (n_buckets - 1)


@njit(cache=True)
def _unlink(cells: _Cells, name: int) -> None:
    level, column, row = cells.key[name]
    after, before = cells.following[name], cells.preceding[name]
    if after != _FREE:
        cells.preceding[after] = before
    if before != _FREE:
        cells.following[before] = after
    else:
        cells.head[_bucket(level, column, row, len(cells.head))] = after
    cells.population[level] -= 1
    cells.key[name, 0] = _FREE


@njit(cache=True)
def _place(cells: _Cells, names: np.ndarray, boxes: Float, cell_m: float) -> None:
    for name in names:
        box = boxes[name]
        extent = max(box[2] - box[0], box[3] - box[1])
        level, size = 0, cell_m
        while size < extent and level < _LEVELS - 1:
            level += 1
            size *= 2
        column, row = int(np.floor(box[0] / size)), int(np.floor(box[1] / size))
        key = cells.key[name]
        if key[0] == level and key[1] == column and key[2] == row:
            continue
        if key[0] != _FREE:
            _unlink(cells, name)
        bucket = _bucket(level, column, row, len(cells.head))
        first = cells.head[bucket]
        if first != _FREE:
            cells.preceding[first] = name
        cells.following[name], cells.preceding[name] = first, _FREE
        cells.head[bucket] = name
        key[0], key[1], key[2] = level, column, row
        cells.population[level] += 1


@njit(cache=True)
def _remove(cells: _Cells, names: np.ndarray) -> None:
    for name in names:
        if cells.key[name, 0] != _FREE:
            _unlink(cells, name)


@njit(cache=True)
def _most_cells(cells: _Cells, box: Float, cell_m: float) -> float:
    """Cells that a query looks at on the finest level in use."""
    for level in range(_LEVELS):
        if cells.population[level] > 0:
            size = cell_m * 2.0**level
            return ((box[2] - box[0]) / size + 2) * ((box[3] - box[1]) / size + 2)
    return 0.0


@njit(cache=True)
def _near(cells: _Cells, box: Float, boxes: Float, cell_m: float) -> np.ndarray:
    found = np.empty(cells.population.sum(), dtype=np.int64)
    n = 0
    for level in range(_LEVELS):
        if cells.population[level] == 0:
            continue
        size = cell_m * 2.0**level
        first_column, last_column = int(np.floor(box[0] / size)) - 1, int(np.floor(box[2] / size))
        first_row, last_row = int(np.floor(box[1] / size)) - 1, int(np.floor(box[3] / size))
        for column in range(first_column, last_column + 1):
            for row in range(first_row, last_row + 1):
                name = cells.head[_bucket(level, column, row, len(cells.head))]
                while name != _FREE:
                    key, other = cells.key[name], boxes[name]
                    # Cells that share a bucket are told apart by the key.
                    if (
                        key[0] == level
                        and key[1] == column
                        and key[2] == row
                        and other[0] <= box[2]
                        and other[2] >= box[0]
                        and other[1] <= box[3]
                        and other[3] >= box[1]
                    ):
                        found[n] = name
                        n += 1
                    name = cells.following[name]
    return found[:n]
