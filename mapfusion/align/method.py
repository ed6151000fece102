"""What an alignment method is: from pairs of landmarks to a motion, or to why there is none."""

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from mapfusion.align.degeneracy import why_one_line, why_one_place
from mapfusion.align.pairs import Pairs
from mapfusion.se2 import Float


@dataclass(frozen=True)
class Needs:
    """What a method asks of the pairs; with less it is not called.

    Attributes:
        pairs: how many at least.
        dimensions: 1 when they must not lie on one point of either map, 2 when those of map b must
            not lie on one line; 0 when the method sees to it itself.
    """

    pairs: int = 2
    dimensions: int = 0

    def why_without_extent(self, pairs: Pairs) -> str:
        """Why the pairs span too little; empty when they do not."""
        if self.dimensions == 0:
            return ""
        return why_one_place(pairs, which="") if self.dimensions == 1 else why_one_line(pairs)


@dataclass(frozen=True)
class Fit:
    """A motion that a method found, and the residuals that made it.

    Attributes:
        T_a_b: (3,) finite.
        inlier: (N,) bool, which of the pairs given support it.
        weight: (n,) of the fitted pairs in the least squares; all equal by default.
        gain: how much each fitted pair's residual moved the motion (n, 3, 2), where that is not the
            least squares of `weight`.
        fitted: the n pairs whose residuals made it; the inliers by default.
        gate_m: radius beyond which residuals were not fitted.
        refusal: why the motion is not to be trusted, if so.
    """

    T_a_b: Float
    inlier: np.ndarray
    weight: Float | None = None
    gain: Float | None = None
    fitted: Pairs | None = None
    gate_m: float = math.inf
    refusal: str = ""


@dataclass(frozen=True)
class Undetermined:
    """The pairs determine no motion; the reason is one a person can act on."""

    reason: str


class Method(Protocol):
    """An alignment method.

    It may also have `needs`, a `Needs` (with less it is not called), and `height`, a `HeightGate`
    (it is given only the pairs whose heights agree).
    """

    randomised: ClassVar[bool]  # whether another generator can give another answer

    def find(self, pairs: Pairs, rng: np.random.Generator) -> Fit | Undetermined:
        """T_a_b of the pairs, and which of them support it."""
        ...


def supported(
    pairs: Pairs, inlier: np.ndarray, T_a_b: Float, refusal: str = ""
) -> Fit | Undetermined:
    """A motion that is the least squares, equally weighted, of the pairs marked (N,) bool.

    Fewer than two are a refusal; all in one place, they leave the angle open.
    """
    n = int(np.count_nonzero(inlier))
    if n < 2:
        return Fit(T_a_b, inlier, refusal=refusal or f"{n} correspondences support the motion")
    support = pairs[inlier]
    reason = why_one_place(support)
    return Undetermined(reason) if reason else Fit(T_a_b, inlier, fitted=support, refusal=refusal)
