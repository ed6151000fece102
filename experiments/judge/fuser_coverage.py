"""Whether ellipses hold as many true points as they say: at several probabilities, by fuser.

Of the maps before fusing too, with the landmarks of all robots together. The landmarks are those
of `map_consistency.py`: gross ones are left out. A share below its probability is of maps that are
too sure, one above of maps that know more than they say.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from experiments.judge.errors import EvaluatedRobot
from experiments.judge.judged_fusers import JudgedFusion
from experiments.judge.map_consistency import Consistency, both_consistencies, fitted
from experiments.judge.truth import degrees_of_freedom
from mapfusion.chi_square import chi_square_bound
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float

# Shares of the errors that ellipses are to hold; closer together where gates and bounds are set.
NOMINAL = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)
FUSED, FILTERED, SMOOTHED = "fused", "filter", "smoothed"  # of which maps
_Both = tuple[Consistency, Consistency]  # after the best rigid fit, and in the map's frame


def coverage_rows(fusions: Sequence[JudgedFusion]) -> list[dict[str, Any]]:
    """Rows of the table `fuser_coverage`: what went in at the last iteration, and what came out."""
    last = max((fusion.iteration for fusion in fusions), default=None)
    at_end = [fusion for fusion in fusions if fusion.iteration == last]
    rows = []
    for kind, given in _given(at_end).items():
        rows += _rows(given, at_end[0], {"map": kind, "fuser": ""})
    for fusion in at_end:
        named = {"map": FUSED, "fuser": fusion.fuser}
        rows += _rows([fusion.consistency], fusion, named)
    return rows


def _given(fusions: Sequence[JudgedFusion]) -> dict[str, list[_Both]]:
    """Each robot's maps of each kind that a fuser was given, held against the truth."""
    maps: dict[str, dict[str, tuple[EvaluatedRobot, LandmarkMap, Float]]] = {}
    for given in (given for fusion in fusions for given in fusion.given):
        robot = given.robot
        of_filter = (robot, given.of_filter, given.of_filter_world_m)
        maps.setdefault(FILTERED, {})[robot.name] = of_filter
        if given.landmarks is not given.of_filter:
            own = (robot, given.landmarks, given.points_world_m)
            maps.setdefault(SMOOTHED, {})[robot.name] = own
    return {kind: [_judged(*each) for each in own.values()] for kind, own in maps.items()}


def _judged(robot: EvaluatedRobot, landmarks: LandmarkMap, point_world_m: Float) -> _Both:
    fit = fitted(landmarks, robot.in_map_frame(point_world_m))
    return both_consistencies(landmarks, fit)


def _rows(
    maps: Sequence[_Both], fusion: JudgedFusion, named: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    """One row a probability; none where nothing is known."""
    relative, frame = (
        np.concatenate([each.own_nees for each in both]) for both in zip(*maps, strict=True)
    )
    d = degrees_of_freedom(fusion.fusion.landmarks)
    for nominal in NOMINAL if len(relative) else ():
        bound = chi_square_bound(nominal, d)
        shares = {"coverage": np.mean(relative <= bound), "frame_coverage": np.mean(frame <= bound)}
        about = {"iteration": fusion.iteration, "n_landmarks": len(relative)}
        yield named | about | {"nominal": nominal} | shares
