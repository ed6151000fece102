"""Do the covariances of landmarks say how wrong they are, before merging and after it?

The normalised estimation error squared (NEES; Bar-Shalom, Li, Kirubarajan 2001, ch. 5.4) of a
landmark is chi-square distributed, with as many degrees of freedom as it has coordinates, if its
covariance is right. Maps are compared with the truth in their own frame, the robot's true start
pose, without a fit: what the path's drift does to a landmark is part of its error.
"""

from typing import Any

import numpy as np

from experiments.judge.fused_landmarks import FusedTeam
from experiments.judge.truth import degrees_of_freedom
from mapfusion.aligned_landmarks import ABSENT
from mapfusion.chi_square import chi_square_bound
from mapfusion.landmark_map import LandmarkMap
from mapfusion.merge import FusedMap
from mapfusion.se2 import Float

GATE_PROBABILITY = 0.95


def landmark_nees(landmarks: LandmarkMap, point_m: Float) -> Float:
    """NEES (N,) of landmarks by true points (N, 3) in the map's frame; NaN where unknown."""
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


def landmark_nees_rows(team: FusedTeam, radius_m: float) -> list[dict[str, Any]]:
    """Rows of the table `landmark_nees`: each robot's map, and what became of it when merged.

    Landmarks whose true points lie within the radius are one; fused ones whose parents are not have
    no single truth and are left out of "fused" and "before fusing".
    """
    rows, fused = [], team.fused
    true_rows = np.zeros(0, np.int64) if fused is None else _truly_fused(team, fused, radius_m)
    for place, robot in enumerate(team.robots):
        landmarks, points = robot.at(team.iteration)
        nees = landmark_nees(landmarks, robot.in_map_frame(points))
        rows.append(_row(robot.name, "own", landmarks, nees))
        if fused is not None:
            parents = fused.parents[true_rows, place]
            fused_nees = nees[parents[parents != ABSENT]]
            rows.append(_row(robot.name, "before fusing", landmarks, fused_nees))
    if fused is not None:
        nees = landmark_nees(fused.landmarks, team.robots[0].in_map_frame(team.truth_of(fused)))
        single = np.count_nonzero(fused.parents != ABSENT, axis=1) == 1
        rows.append(_row("fused", "fused", fused.landmarks, nees[true_rows]))
        rows.append(_row("fused", "carried over", fused.landmarks, nees[single]))
    return rows


def _truly_fused(team: FusedTeam, fused: FusedMap, radius_m: float) -> np.ndarray:
    """Rows of the fused map with several parents, all of which show one true point."""
    points, has = team.parent_points(fused), fused.parents != ABSENT
    apart = np.linalg.norm(points[:, :, None] - points[:, None], axis=3)
    both = has[:, :, None] & has[:, None]
    together = np.all(~both | (apart <= radius_m), axis=(1, 2))  # NaN is not together
    return np.flatnonzero(together & (has.sum(axis=1) > 1))


def _row(name: str, which: str, landmarks: LandmarkMap, nees: Float) -> dict[str, Any]:
    nees, dof = nees[np.isfinite(nees)], degrees_of_freedom(landmarks)
    row = {"map": name, "landmarks": which, "n_landmarks": len(nees), "degrees_of_freedom": dof}
    if len(nees):
        row |= {"nees_mean": nees.mean(), "nees_median": np.median(nees)}
        row |= {"share_in_gate": np.mean(nees <= chi_square_bound(GATE_PROBABILITY, dof))}
    return row
