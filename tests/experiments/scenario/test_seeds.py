"""Tests of `experiments.scenario.seeds`."""

import numpy as np
import pytest
from scipy.stats import pearsonr

from experiments.scenario.seeds import generator, parse_seeds
from mapfusion.errors import InputError


def draw(seed: int, *purpose: str | int) -> list[float]:
    return generator(seed, *purpose).standard_normal(4).tolist()


def test_a_generator_depends_on_its_seed_and_purpose_alone() -> None:
    first = draw(1, "odometry", "R1")
    draw(1, "odometry", "R2")
    np.random.default_rng(1).random(100)
    assert draw(1, "odometry", "R1") == first
    others = [draw(2, "odometry", "R1"), draw(1, "odometry", "R2"), draw(1, "R1", "odometry")]
    others += [draw(1, "odometry"), draw(1, "odometry", "R1", 0), draw(1, "slam", "R1")]
    assert first not in others
    assert len({tuple(other) for other in others}) == len(others)


def test_generators_do_not_correlate() -> None:
    """Frames of one robot, neighbours among the purposes: |r| stays below 4 / sqrt(n)."""
    n = 20_000
    streams = [generator(0, "radiometry", "R1", k).standard_normal(n) for k in range(6)]
    for i, first in enumerate(streams):
        for second in streams[i + 1 :]:
            assert abs(pearsonr(first, second).statistic) < 4 / np.sqrt(n)


def test_purposes_are_hashed_the_same_in_every_process() -> None:
    """Python's own hash of text differs from process to process; these numbers may not."""
    assert generator(7, "slam", "R1").integers(0, 10**6, 3).tolist() == [315144, 477990, 873372]


def test_seeds() -> None:
    assert parse_seeds("3") == [3]
    assert parse_seeds("0..4") == [0, 1, 2, 3, 4]
    assert parse_seeds("5,2,0") == [5, 2, 0]
    assert len(parse_seeds("0..999")) == 1000
    with pytest.raises(InputError, match="more than 1000"):
        parse_seeds("0..1000")
