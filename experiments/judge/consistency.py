"""Do the covariances of landmarks say how wrong they are, before merging and after it?

The normalised estimation error squared (NEES; Bar-Shalom, Li, Kirubarajan 2001, ch. 5.4) of a
landmark is chi-square distributed, with as many degrees of freedom as it has coordinates, if its
covariance is right. Maps are compared with the truth in their own frame, the robot's true start
pose, without a fit: what the path's drift does to a landmark is part of its error.
"""

from typing import Any

import numpy as np

from experiments.judge.errors import EvaluatedRobot
from experiments.judge.fused_landmarks import fused_truth, parent_points
from mapfusion import se2
from mapfusion.aligned_landmarks import ABSENT
from mapfusion.chi_square import chi_square_bound
from mapfusion.landmark_map import LandmarkMap
from mapfusion.merge import FusedMap
from mapfusion.se2 import Float

GATE_PROBABILITY = 0.95


def degrees_of_freedom(landmarks: LandmarkMap) -> int:
    """Coordinates that a landmark was estimated in."""
    return 2 if landmarks.planar else 3


def landmark_nees(landmarks: LandmarkMap, point_m: Float) -> Float:
    """NEES (N,) of a map's landmarks; NaN where the truth is unknown.

    Args:
        landmarks: N of them.
        point_m: (N, 3) true points in the map's frame.
    """
    used = degrees_of_freedom(landmarks)
    error = (landmarks.position_m - point_m)[:, :used]
    covariance = landmarks.covariance_m2[:, :used, :used]
    return np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])


def mean_nees_band(n: float, dof: int, probability: float = GATE_PROBABILITY) -> Float:
    """Where the mean of n independent NEES over their degrees of freedom lies, if consistent.

    Their sum is chi-square with n dof degrees of freedom (Bar-Shalom et al. 2001, eq. 5.4.2-14).
    """
    tail = (1 - probability) / 2
    ends = [chi_square_bound(share, n * dof) for share in (tail, 1 - tail)]
    return np.array(ends) / (n * dof)


def landmark_nees_rows(
    robots: list[EvaluatedRobot], fused: FusedMap | None, iteration: int, radius_m: float
) -> list[dict[str, Any]]:
    """Rows of the table `landmark_nees`: each robot's map, and what became of it when merged.

    Args:
        robots: the first one's frame is the fused map's.
        fused: their merged map, if there are several.
        iteration: of the maps.
        radius_m: landmarks whose true points lie within are one; fused ones whose parents are not
            have no single truth and are left out of "fused" and "before fusing".
    """
    rows = []
    true_rows = np.zeros(0, np.int64)
    if fused is not None:
        true_rows = _truly_fused(fused, robots, iteration, radius_m)
    for place, robot in enumerate(robots):
        landmarks, points = robot.at(iteration)
        nees = landmark_nees(landmarks, _in_frame_of(robot, points))
        rows.append(_row(robot.name, "own", landmarks, nees))
        if fused is not None:
            parents = fused.parents[true_rows, place]
            rows.append(
                _row(robot.name, "before fusing", landmarks, nees[parents[parents != ABSENT]])
            )
    if fused is not None:
        truth = _in_frame_of(robots[0], fused_truth(fused, robots, iteration))
        nees = landmark_nees(fused.landmarks, truth)
        single = np.count_nonzero(fused.parents != ABSENT, axis=1) == 1
        rows.append(_row("fused", "fused", fused.landmarks, nees[true_rows]))
        rows.append(_row("fused", "carried over", fused.landmarks, nees[single]))
    return rows


def _in_frame_of(robot: EvaluatedRobot, points_world_m: Float) -> Float:
    return se2.transform_points(se2.inverse(robot.path.T_world_map), points_world_m)


def _truly_fused(
    fused: FusedMap, robots: list[EvaluatedRobot], iteration: int, radius_m: float
) -> np.ndarray:
    """Rows of the fused map with several parents, all of which show one true point."""
    points = parent_points(fused, robots, iteration)
    has = fused.parents != ABSENT
    apart = np.linalg.norm(points[:, :, None] - points[:, None], axis=3)
    both = has[:, :, None] & has[:, None]
    together = np.all(~both | (apart <= radius_m), axis=(1, 2))  # NaN is not together
    return np.flatnonzero(together & (has.sum(axis=1) > 1))


def _row(name: str, which: str, landmarks: LandmarkMap, nees: Float) -> dict[str, Any]:
    nees = nees[np.isfinite(nees)]
    dof = degrees_of_freedom(landmarks)
    gate = chi_square_bound(GATE_PROBABILITY, dof)
    some = len(nees) > 0
    return {
        "map": name,
        "landmarks": which,
        "n_landmarks": len(nees),
        "degrees_of_freedom": dof,
        "nees_mean": nees.mean() if some else np.nan,
        "nees_median": np.median(nees) if some else np.nan,
        "share_in_gate": np.mean(nees <= gate) if some else np.nan,
    }
