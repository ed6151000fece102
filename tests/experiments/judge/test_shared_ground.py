"""When robots first share ground, in worlds where it is known."""

import numpy as np

from experiments.evaluation.alignment_errors import EvaluatedRobot, first_shared_iteration
from experiments.evaluation.truth import PathTruth
from tests.helpers.made_up_maps import landmark_map

RADIUS_M = 0.1
WORLD = np.random.default_rng(0).uniform(0, 20, (40, 3))  # no two within the radius


def seeing(name: str, by_iteration: dict[int, list[int]], off_m: float = 0.0) -> EvaluatedRobot:
    """A robot that has these points of the world in its maps, each off by so much along x."""
    points = {k: WORLD[rows] + [off_m, 0, 0] for k, rows in by_iteration.items()}
    maps = {k: landmark_map(own, name) for k, own in points.items()}
    return EvaluatedRobot(name, maps, points, PathTruth(np.zeros((1, 3)), np.zeros(3)))


def first(*robots: EvaluatedRobot) -> int | None:
    return first_shared_iteration(robots, RADIUS_M)


def test_three_common_landmarks_of_any_two_are_shared_ground() -> None:
    a = seeing("R1", {10: [0, 1], 20: [0, 1, 2, 3], 30: [0, 1, 2, 3]})
    b = seeing("R2", {10: [0, 1], 20: [2, 3, 8, 9], 30: [1, 2, 3, 8]})
    assert first(a, b) == 30  # two are too few
    c = seeing("R3", {10: [9], 20: [2, 8, 9], 30: [9]})
    assert first(a, b, c) == 20  # R2 and R3, whatever is later
    assert first(c, b, a) == 20


def test_points_beside_each_other_are_not_one() -> None:
    a, rows = seeing("R1", {10: [0, 1, 2], 20: [0, 1, 2]}), {10: [0, 1, 2], 20: [0, 1, 2]}
    assert first(a, seeing("R2", rows, 0.9 * RADIUS_M)) == 10
    assert first(a, seeing("R2", rows, 1.1 * RADIUS_M)) is None


def test_a_robot_whose_log_has_ended_keeps_its_map() -> None:
    a = seeing("R1", {10: [0, 1, 2]})
    b = seeing("R2", {10: [5, 6, 7], 20: [5, 6, 7], 30: [0, 1, 2]})
    assert first(a, b) == 30
