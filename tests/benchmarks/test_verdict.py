"""Speed of the verdict: `pytest tests/benchmarks/test_verdict.py --benchmark-only`.

Bars: 5 ms for maps of 1600 landmarks, 20 ms for 5000; what is found once for two maps has none.
"""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from mapfusion.align.alignment import Pairs
from mapfusion.align.correspondences import match
from mapfusion.align.refinement import Oracle
from mapfusion.verification.verdict import Verifier
from tests.mapfusion.verification.two_rooms import Wall, mapped

PER_M = 40  # landmarks along a wall, as in rooms


def pairs_of(n: int) -> Pairs:
    """Two maps of about so many landmarks, half of them common."""
    length_m = n / PER_M
    wall = Wall(1.6 * length_m, seed=1, per_m=PER_M)
    a = mapped(wall, 1.0, length_m, seed=2, name="A")
    b = mapped(wall, 0.5 * length_m, 1.5 * length_m, seed=3, name="B")
    return Pairs(a, b, match(a, b))


@pytest.mark.parametrize("n", [1600, 5000])
def test_verdict(benchmark, n):
    pairs = pairs_of(n)
    judge = Verifier().on(pairs)
    alignment = Oracle().align(pairs, np.ones(len(pairs), bool))
    judge.verify(alignment)  # seeks what is found once for two maps
    steps = itertools.count(1)

    def verdict():
        """Return the verdict on a new motion; visibility under known motions is cached."""
        T_a_b = alignment.T_a_b + next(steps) * 1e-12
        return judge.verify(replace(alignment, T_a_b=T_a_b))

    assert benchmark(verdict).accepted


@pytest.mark.parametrize("n", [1600, 5000])
def test_evidence_of_two_maps(benchmark, n):
    pairs = pairs_of(n)
    assert benchmark(lambda: Verifier().on(pairs).evidence) is not None
