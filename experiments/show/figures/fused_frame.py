"""Fused landmarks beside their parents, all in the frame of the fused map."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from experiments.show.figures.result_tables import (
    NothingToDraw,
    Pair,
    ResultTables,
    positions_and_covariances,
)
from mapfusion.align.rigid import fit_rigid
from mapfusion.se2 import Float, transform_covariances, transform_points

_MIN_POINTS = 2  # that fix a rigid motion of the plane


@dataclass(frozen=True)
class FusedPairs:
    """N landmarks that were fused from one landmark of each of two robots.

    Attributes:
        robots: the parents' robots.
        position_m: (3, N, 3) of the first parent, the second parent and the fused landmark.
        covariance_m2: (3, N, 3, 3) likewise; the parents' as the merge weighed them, so with what
            it added to the maps' own for their drift.
        own_covariance_m2: (2, N, 3, 3) of the parents, without that.
    """

    robots: Pair
    position_m: Float
    covariance_m2: Float
    own_covariance_m2: Float


def fused_pairs(data: ResultTables) -> FusedPairs:
    """The fused landmarks of the robot pair that shares the most of them.

    Raises:
        NothingToDraw: nothing was fused, or the map does not tell how the robots' maps were moved.
    """
    fused = data.table("fused")
    rows = fused[(fused["n_parents"] == 2) & (fused["robot_b"] != "")]
    if rows.empty:
        raise NothingToDraw("no two landmarks were fused")
    robots = _most_common_pair(rows)
    rows = rows[(rows["robot_a"] == robots[0]) & (rows["robot_b"] == robots[1])]
    positions, covariances, own_covariances = [], [], []
    for robot, index in zip(robots, ("landmark_a", "landmark_b"), strict=True):
        moved = moved_map(data, robot)
        chosen = rows[index].to_numpy()
        positions.append(moved[0][chosen])
        covariances.append(moved[1][chosen])
        own_covariances.append(moved[2][chosen])
    position, covariance = positions_and_covariances(rows)
    return FusedPairs(
        robots,
        np.stack([*positions, position]),
        np.stack([*covariances, covariance]),
        np.stack(own_covariances),
    )


def _most_common_pair(rows: pd.DataFrame) -> Pair:
    counts = rows.groupby(["robot_a", "robot_b"], sort=False).size()
    robot_a, robot_b = counts.index[int(np.argmax(counts.to_numpy()))]
    return robot_a, robot_b


def moved_map(data: ResultTables, robot: str) -> tuple[Float, Float, Float]:
    """A robot's last map as it went into the merge.

    A landmark that only this robot had was carried over as it went in: moved, its covariance turned
    and widened by the map's drift. So the landmarks carried over tell the motion (closed-form least
    squares, exact here) and the widening (the mean of what was added).

    Returns:
        Positions (N, 3), covariances (N, 3, 3), and these before they were widened.
    """
    fused = data.table("fused")
    carried = fused[(fused["n_parents"] == 1) & (fused["robot_a"] == robot)]
    if len(carried) < _MIN_POINTS:
        raise NothingToDraw(f"too few of {robot}'s landmarks were carried over to place its map")
    position, covariance = data.landmarks_of(robot)
    went_in, went_in_covariance = positions_and_covariances(carried)
    rows = carried["landmark_a"].to_numpy()
    T_fused_robot = np.array(fit_rigid(went_in, position[rows], np.arange(len(rows))))
    turned = transform_covariances(T_fused_robot, covariance)
    added = (went_in_covariance - turned[rows]).mean(axis=0)
    return transform_points(T_fused_robot, position), turned + added, turned
