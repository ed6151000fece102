"""Fused landmarks beside their parents, all in the frame of the fused map."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from experiments.figures.result_tables import (
    NothingToDraw,
    Pair,
    ResultTables,
    positions_and_covariances,
)
from mapfusion.align.rigid import fit_rigid
from mapfusion.se2 import IDENTITY, Float, transform_covariances, transform_points

_MIN_POINTS = 2  # that fix a rigid motion of the plane


@dataclass(frozen=True)
class FusedPairs:
    """N landmarks that were fused from one landmark of each of two robots.

    Attributes:
        robots: the parents' robots.
        position_m: (3, N, 3) of the first parent, the second parent and the fused landmark.
        covariance_m2: (3, N, 3, 3) likewise.
    """

    robots: Pair
    position_m: Float
    covariance_m2: Float


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
    positions, covariances = [], []
    for robot, index in zip(robots, ("landmark_a", "landmark_b"), strict=True):
        T_fused = T_fused_robot(data, robot)
        position, covariance = data.landmarks_of(robot)
        chosen = rows[index].to_numpy()
        positions.append(transform_points(T_fused, position[chosen]))
        covariances.append(transform_covariances(T_fused, covariance[chosen]))
    position, covariance = positions_and_covariances(rows)
    return FusedPairs(
        robots, np.stack([*positions, position]), np.stack([*covariances, covariance])
    )


def _most_common_pair(rows: pd.DataFrame) -> Pair:
    counts = rows.groupby(["robot_a", "robot_b"], sort=False).size()
    robot_a, robot_b = counts.index[int(np.argmax(counts.to_numpy()))]
    return robot_a, robot_b


def T_fused_robot(data: ResultTables, robot: str) -> Float:  # noqa: N802  # the field's notation
    """The motion (3,) by which the merge brought a robot's map into the fused one.

    A landmark that only this robot had was carried over, moved by that motion and nothing else; so
    the closed-form least squares over those landmarks gives it back exactly.
    """
    if robot == data.robots[0]:
        return IDENTITY
    fused = data.table("fused")
    carried = fused[(fused["n_parents"] == 1) & (fused["robot_a"] == robot)]
    if len(carried) < _MIN_POINTS:
        raise NothingToDraw(f"too few of {robot}'s landmarks were carried over to place its map")
    position, _ = data.landmarks_of(robot)
    moved, _ = positions_and_covariances(carried)
    own = position[carried["landmark_a"].to_numpy()]
    return np.array(fit_rigid(moved, own, np.arange(len(own))))
