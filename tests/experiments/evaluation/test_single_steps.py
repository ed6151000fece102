"""Maps of the user's own, whatever the order in which the command names them."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from experiments.evaluation.single_steps import align, merge
from experiments.scenario.loading import default_settings
from mapfusion.align.alignment import Pairs
from mapfusion.align.icp import Icp
from mapfusion.landmark_map import write_map
from tests.mapfusion.robots_of_one_world import Robots
from tests.mapfusion.same_fusion import assert_same_points

# m and rad: the iterations of joint fusion end a thirtieth of a sigma before they stand still
WITHIN = 3e-3


@pytest.fixture
def paths(tmp_path: Path) -> list[Path]:
    """Four overlapping maps with drift, of which RANSAC draws."""
    robots = Robots([slice(40 * k, 40 * k + 120) for k in range(4)], drift_m=0.05)
    files = [tmp_path / f"map {k}.parquet" for k in range(4)]
    for path, landmarks in zip(files, robots.maps, strict=True):
        write_map(path, landmarks)
    return files


def test_the_order_of_the_files_changes_nothing_but_the_frame(paths: list[Path]) -> None:
    settings = default_settings(["merge.aligner=ransac"], 0)
    one = merge(paths, settings).fusion.fused[0]
    assert len(one.members) == 4
    orders = list(itertools.permutations(range(4)))
    for place in np.random.default_rng(0).choice(len(orders), 4, replace=False):
        order = orders[place]
        two = merge([paths[k] for k in order], settings).fusion.fused[0]
        assert_same_points(one, two, order, WITHIN)


def test_a_call_that_is_timed_finds_nothing_of_the_one_before(
    paths: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    found, given = Icp.find, list[Pairs]()

    def find(method: Icp, pairs: Pairs, rng: np.random.Generator) -> object:
        given.append(pairs)  # which keep what helps a later call on the same
        return found(method, pairs, rng)

    monkeypatch.setattr(Icp, "find", find)
    rows = align(paths[0], paths[1], default_settings([], 0))
    assert {row["aligner"] for row in rows} >= {"icp", "ransac"}
    first, timed = given
    assert first is not timed
