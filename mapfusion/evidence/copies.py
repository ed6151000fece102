"""What of two maps may be a copy: the places that a motion lays on their like."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from mapfusion.align.closest import Grid, runs_about
from mapfusion.kernels import kernel

# A place is that of a landmark, as far about it as the smallest posters are wide (half a metre):
# neighbouring corners of one picture.
_PLACE_M = 0.5
# It is laid on its like where so many landmarks of it are found, as a region needs to count, and so
# large a share: from about there on it is ten times likelier that a copy was seen from elsewhere
# than that chance found as many (`fitted_rates.py`, what may be seen: 7 of 20, 17 of 60).
_LEAST, _LEAST_SHARE = 5, 0.3


BETWEEN = "a b"  # of a motion between two maps; of one map onto itself: a, b


class Copies(NamedTuple):
    """Which landmarks of two maps lie in places that may be copies: bool (N_a,) and (N_b,)."""

    in_a: np.ndarray
    in_b: np.ndarray

    @classmethod
    def none(cls, n_a: int, n_b: int) -> "Copies":
        """Of maps in which nothing is held twice."""
        return cls(np.zeros(n_a, np.bool_), np.zeros(n_b, np.bool_))

    def joined(self, others: Iterable["Copies"]) -> "Copies":
        """Those of any of several motions."""
        in_a, in_b = self.in_a.copy(), self.in_b.copy()
        for other in others:
            in_a |= other.in_a
            in_b |= other.in_b
        return Copies(in_a, in_b)


def of_others(copies: Sequence[Copies], own: int) -> Copies:
    """What motions but one of them lay on its like."""
    first = Copies.none(len(copies[own].in_a), len(copies[own].in_b))
    return first.joined(each for k, each in enumerate(copies) if k != own)


@kernel
def about_each(counted: np.ndarray, near: Grid) -> np.ndarray:
    """How many of the landmarks about each (N,) are `counted` (N,), itself among them."""
    p, row_of = near.p, near.row
    n = np.zeros(len(counted), np.int64)
    runs = np.empty((near.shape[1], 2), np.int64)
    for k in range(len(p)):
        if not counted[row_of[k]]:
            continue
        for run in range(runs_about(p[k, 0], p[k, 1], _PLACE_M, near, runs)):
            for m in range(runs[run, 0], runs[run, 1]):
                dx, dy = p[m, 0] - p[k, 0], p[m, 1] - p[k, 1]
                n[row_of[m]] += dx * dx + dy * dy <= _PLACE_M * _PLACE_M
    return n


def laid_on_like(found: np.ndarray, crowd: np.ndarray, near: Grid) -> np.ndarray:
    """Which landmarks (N,) lie where enough of those about them are `found` (N,) elsewhere.

    Of `crowd` (N,) is how many there are about each.
    """
    hits = about_each(found, near)
    return (hits >= _LEAST) & (hits >= _LEAST_SHARE * crowd)
