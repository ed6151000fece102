"""Acceptance: is the support of an alignment more than chance would give for these two maps?"""

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from mapfusion.align.correspondences import HeightGate
from mapfusion.align.false_alarms import (
    IndependentPairs,
    fewest_false_alarms,
    independent_pairs,
    thin,
)
from mapfusion.align.named_landmarks import named_false_alarms
from mapfusion.align.pairs import MIN_PAIRS, Pairs
from mapfusion.align.result import Alignment, Status
from mapfusion.arguments import Range, require_in_range
from mapfusion.se2 import Float

_MAX_GATES = 20  # each is another pass over all pairs


@dataclass(frozen=True)
class Verdict:
    """Whether an alignment may be used.

    Attributes:
        status: accepted, or why not; that of the alignment where it failed before.
        log10_false_alarms: decimal logarithm of how many alignments at least this well supported
            chance is expected to give for these two maps; NaN where there was none to judge.
        reason: what a person can act on, or has to know of an accepted one; else empty.
        log10_evidence: decimal logarithm of how much likelier what both robots saw is if it is
            right; NaN where none was sought.
        n_confirmed: regions that both must have seen, and have.
        n_contradicted: regions that one of them lacks.
        probability: that it is right; NaN where no evidence was sought.
    """

    status: Status
    log10_false_alarms: float
    reason: str = ""
    log10_evidence: float = math.nan
    n_confirmed: int = 0
    n_contradicted: int = 0
    probability: float = math.nan

    @property
    def accepted(self) -> bool:
        """By the estimator and by all tests."""
        return self.status is Status.ACCEPTED

    def applied_to(self, alignment: Alignment) -> Alignment:
        """The alignment with the status of the verdict; a failed one stays what it is."""
        if self.accepted or not alignment.ok:
            return alignment
        return replace(alignment, status=self.status, reason=self.reason)


@dataclass(frozen=True)
class Acceptance:
    """A-contrario test of an alignment, the same for every estimator (Moisan and Stival 2004).

    Against it stands chance: all correspondences false, each landmark of map a paired with a random
    one of the same height among map b's. Under a motion T such a pair agrees within a gate with a
    probability p(T), the share that do so among all re-pairings of the very landmarks at hand; maps
    made of walls have a larger p(T) where T lays wall on wall. A motion that two of n
    correspondences determine then finds k - 2 supporters or more among the others with probability
    at most the binomial's tail B(k - 2; n - 2, p) (pairs of unequal p only make it smaller:
    Hoeffding 1956), and the expected number of such motions among all n (n - 1) / 2 is at most

        NFA = tests * n (n - 1) / 2 * B(k - 2; n - 2, p(T)),

    where `tests` counts the gates and selections tried. An alignment is judged by the motion of two
    of its own supporters that lies nearest to it; only those count that both bring together. So
    whatever estimator was used, and however often: two maps without common ground have an
    acceptable alignment with probability at most `false_alarms`.

    Two things would break this and are met. Neighbours are not independent: corners of one patch
    share most of their descriptors' windows, and one point may be in a map twice. So of
    correspondences that are neighbours in both maps only the best-matching one is used. And n false
    ones can hide few true ones: the best-matching half, quarter, ... are tested as well.

    Known identities are another matter: see `named_landmarks.py`.

    What it cannot see: texture that repeats is not chance. A poster that hangs on two walls gives
    as many supporters as common ground does (`mapfusion/evidence` sees to that).

    Attributes:
        false_alarms: accepted expected number of chance alignments for a pair of maps.
        gates_m: distances in the plane up to which a pair supports a motion: from a landmark's own
            noise to what drift displaces true pairs by.
        patch_m: correspondences nearer than this to each other, in both maps, are one: without
            common ground such neighbours are far more frequent than under re-pairing.
        height: which landmarks can have one height (not for planar maps).
    """

    false_alarms: Annotated[float, Range(1e-100, 1, "1")] = 1e-3
    gates_m: tuple[Annotated[float, Range(1e-3, 100, "m")], ...] = (0.05, 0.1, 0.2, 0.4)
    patch_m: Annotated[float, Range(0, 100, "m")] = 0.2
    height: HeightGate = field(default_factory=HeightGate)

    def __post_init__(self) -> None:
        require_in_range(self)
        if not 1 <= len(self.gates_m) <= _MAX_GATES:
            raise ValueError(f"gates_m: expected 1 to {_MAX_GATES} distances")

    def judge(self, pairs: Pairs, alignment: Alignment) -> Verdict:
        """Hold an alignment of these correspondences against chance."""
        return self.on(pairs).judge(alignment)

    def on(self, pairs: Pairs) -> "ChanceTest":
        """The test for these correspondences, made ready for any number of alignments."""
        gates_m = np.array(sorted(self.gates_m))
        if pairs.by_name:
            in_plan = pairs.in_plan()
            return ChanceTest(self.false_alarms, gates_m, (in_plan.p_a, in_plan.p_b))
        pairs = pairs[self._independent(pairs)]
        planar = pairs.in_plan()
        independent = independent_pairs(planar.p_a, planar.p_b, self._heights(pairs))
        return ChanceTest(self.false_alarms, gates_m, independent)

    def _independent(self, pairs: Pairs) -> np.ndarray:
        """Rows (n,) of the pairs that count, best match first."""
        rows = pairs.of_one_height(self.height)
        rows = rows[np.argsort(pairs.distance[rows], kind="stable")]
        return rows[thin(*pairs[rows].points(), self.patch_m)]

    def _heights(self, pairs: Pairs) -> Float:
        """Heights (n, 4) as `IndependentPairs` has them; of planar maps all 0."""
        if pairs.planar:
            return np.zeros((len(pairs), 4))
        bound = self.height.bound
        variance_a = pairs.covariance_a[:, 2, 2]
        variance_b = pairs.covariance_b[:, 2, 2] + self.height.floor_m**2
        return np.stack(
            [pairs.p_a[:, 2], pairs.p_b[:, 2], bound * variance_a, bound * variance_b], axis=1
        )


@dataclass(frozen=True)
class ChanceTest:
    """`Acceptance` for the independent correspondences of two maps.

    Attributes:
        false_alarms: accepted expected number of chance alignments.
        gates_m: (G,) ascending.
        pairs: the correspondences, or the places (N, 2) of namesakes in both maps.
    """

    false_alarms: float
    gates_m: Float
    pairs: IndependentPairs | tuple[Float, Float]

    def judge(self, alignment: Alignment) -> Verdict:
        """Hold one alignment of the correspondences against chance."""
        if not alignment.ok or not np.all(np.isfinite(alignment.T_a_b)):
            return Verdict(alignment.status, math.nan, alignment.reason)
        if isinstance(self.pairs, IndependentPairs):
            found = fewest_false_alarms(self.pairs, alignment.T_a_b, self.gates_m)
        else:
            found = named_false_alarms(*self.pairs, alignment.T_a_b, self.gates_m)
        log10, gate_m, n, k = found
        if log10 <= math.log10(self.false_alarms):
            return Verdict(Status.ACCEPTED, log10)
        return Verdict(Status.REFUSED, log10, self._why(log10, gate_m, n, k))

    def _why(self, log10: float, gate_m: float, n: int, k: int) -> str:
        if n < MIN_PAIRS:
            return f"{n} independent correspondences are too few to tell from chance"
        if k < MIN_PAIRS:
            return f"fewer than {MIN_PAIRS} of {n} independent correspondences support it"
        times = f"{10**log10:.2g}" if log10 < 4 else f"1e{log10:.0f}"
        return (
            f"{k} of {n} independent correspondences agree within {gate_m:g} m; chance alone gives "
            f"as much {times} times for these maps, {self.false_alarms:g} are allowed"
        )
