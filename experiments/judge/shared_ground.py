"""When robots first share ground: by the truth, and so for judging alone."""

import itertools
from collections.abc import Sequence

from experiments.judge.criteria import COMMON_LANDMARKS
from experiments.judge.errors import EvaluatedRobot
from experiments.judge.truth import common_landmarks


def first_shared_iteration(robots: Sequence[EvaluatedRobot], radius_m: float) -> int | None:
    """The first evaluated iteration at which the maps of any two have common ground; None if never.

    Args:
        robots: all of a team.
        radius_m: landmarks whose true points lie this near are one.
    """
    for k in sorted({k for robot in robots for k in robot.maps}):
        points = [robot.at(k)[1] for robot in robots]
        for a, b in itertools.combinations(points, 2):
            if common_landmarks(a, b, radius_m) >= COMMON_LANDMARKS:
                return k
    return None
