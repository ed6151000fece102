"""Tests of `experiments.pipeline.stages.align`."""

import numpy as np
import pandas as pd

from experiments.pipeline.stages.align import evidence_of, rival_rows
from experiments.pipeline.tables import at_iteration
from mapfusion.align.alignment import Pairs
from mapfusion.align.correspondences import match
from mapfusion.verification.verdict import Verifier
from tests.mapfusion.verification.two_rooms import Wall, mapped


def test_evidence_comes_back_from_the_rows_of_rivals() -> None:
    """The evidence of a wall with repeated structure is read back from its rows."""
    wall = Wall(16, seed=1, copies=[(0.0, 8.0, 8.0)])
    maps = mapped(wall, 0, 16, seed=2, name="A"), mapped(wall, 2, 14, seed=3, name="B")
    judge = Verifier()
    found = judge.on(Pairs(*maps, match(*maps))).evidence
    assert found is not None
    assert any(each.copies.in_a.any() and each.copies.in_b.any() for each in found.motions)
    again = evidence_of(pd.DataFrame(rival_rows({}, found)), maps, judge.evidence)
    assert (again.shares, again.region_m) == (found.shares, found.region_m)
    assert len(again.motions) == len(found.motions)
    for one, two in zip(again.motions, found.motions, strict=True):
        np.testing.assert_equal(vars(one), vars(two))


def test_rows_of_an_iteration_are_those_that_say_so() -> None:
    rows = pd.DataFrame({"iteration": [0, 0, 25, 50, 50, 50], "value": range(6)})
    for iteration in (-1, 0, 25, 30, 50, 75):
        expected = rows[rows["iteration"] == iteration]
        pd.testing.assert_frame_equal(at_iteration(rows, iteration), expected)
