"""Landmark maps of one made-up world, seen by two robots whose poses are known."""

import numpy as np
import pandas as pd

from experiments.evaluation.truth import EvaluatedRobot, PathTruth
from experiments.pipeline.tables import RIVALS
from mapfusion.align.alignment import Status
from mapfusion.align.correspondences import Correspondences
from mapfusion.geometry import se2
from mapfusion.geometry.numerics import Float
from mapfusion.landmark_map import LandmarkMap
from mapfusion.verification.false_alarms import Verdict

ITERATION = 7
ACCEPTED = Verdict(Status.ACCEPTED, -50.0)
NO_RIVALS = pd.DataFrame(columns=pd.Index(RIVALS.names))


def landmark_map(
    position_m: Float, name: str = "R1", sigma_m: float = 0.01, planar: bool = False
) -> LandmarkMap:
    """Landmarks of equal, isotropic uncertainty."""
    n = len(position_m)
    return LandmarkMap(
        position_m,
        np.tile(sigma_m**2 * np.eye(3), (n, 1, 1)),
        np.full(n, 5, np.int32),
        np.arange(n, dtype=np.int64),
        planar=planar,
        name=name,
    )


def robot(
    name: str,
    points_world_m: Float,
    T_world_map: Float,
    noise_m: Float | float = 0.0,
    sigma_m: float = 0.01,
) -> EvaluatedRobot:
    """A robot whose map holds these world points, moved into its frame, plus noise (N, 3)."""
    position = se2.transform_points(se2.inverse(T_world_map), points_world_m) + noise_m
    landmarks = landmark_map(position, name, sigma_m)
    path = PathTruth(np.zeros((ITERATION + 1, 3)), np.asarray(T_world_map))
    return EvaluatedRobot(name, {ITERATION: landmarks}, {ITERATION: points_world_m}, path)


def offered(a: str, b: str, pairs: Correspondences) -> pd.DataFrame:
    """Correspondences as rows of their table."""
    return pd.DataFrame(
        {
            "robot_a": a,
            "robot_b": b,
            "iteration": ITERATION,
            "index_a": pairs.index_a,
            "index_b": pairs.index_b,
            "descriptor_distance": pairs.distance,
        }
    )


def paired(index_a: list[int], index_b: list[int]) -> Correspondences:
    """Correspondences without descriptor distances."""
    return Correspondences(np.array(index_a), np.array(index_b), np.zeros(len(index_a)))
