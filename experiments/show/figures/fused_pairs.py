"""Landmarks that two robots share: each one's own, moved as the merge moved it, and the fused."""

from dataclasses import dataclass

import numpy as np

from experiments.judge.tables import table_path
from experiments.show.figures.result_tables import (
    NothingToDraw,
    Pair,
    ResultTables,
    of_pair,
    positions_and_covariances,
)
from experiments.show.figures.style import FUSED_COLOUR
from mapfusion.se2 import Float, transform_covariances, transform_points

MARKERS = ("*", "^", "s")  # of the first parent, the second and the fused landmark


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

    def colours(self, data: ResultTables) -> list[str]:
        """Of the two parents and the fused landmark."""
        return [*(data.colours[robot] for robot in self.robots), FUSED_COLOUR]


def fused_pairs(data: ResultTables) -> FusedPairs:
    """The fused landmarks of the robot pair that shares the most of them.

    Raises:
        NothingToDraw: nothing was fused, or the result does not tell how the maps were moved.
    """
    fused = data.table("fused")
    rows = fused[(fused["n_parents"] == 2) & (fused["robot_b"] != "")]
    if rows.empty:
        raise NothingToDraw("no two landmarks were fused")
    counts = rows.groupby(["robot_a", "robot_b"], sort=False).size()
    robot_a, robot_b = counts.index[int(np.argmax(counts.to_numpy()))]
    rows = of_pair(rows, (robot_a, robot_b))
    position, covariance = positions_and_covariances(rows)
    parents = [
        [values[rows[index].to_numpy()] for values in moved_map(data, robot)]
        for robot, index in ((robot_a, "landmark_a"), (robot_b, "landmark_b"))
    ]
    moved, widened, own = (np.stack(values) for values in zip(*parents, strict=True))
    return FusedPairs(
        (robot_a, robot_b),
        np.concatenate([moved, position[None]]),
        np.concatenate([widened, covariance[None]]),
        own,
    )


def moved_map(data: ResultTables, robot: str) -> tuple[Float, Float, Float]:
    """A robot's last map as it went into the merge.

    Returns:
        Positions (N, 3), covariances (N, 3, 3), and these before they were widened by the drift.
    """
    if not table_path(data.folder, "fused_motions").is_file():
        raise NothingToDraw("made before fused motions were stored: run it again")
    motions = data.table("fused_motions").set_index("robot").loc[robot]
    T_fused_robot = motions[["tx_m", "ty_m", "theta_rad"]].to_numpy(dtype=np.float64)
    position, covariance = data.landmarks_of(robot)
    turned = transform_covariances(T_fused_robot, covariance)
    drift_m2 = motions["drift_sigma_m"] ** 2 * np.diag([1.0, 1.0, 0.0])  # heights do not drift
    return transform_points(T_fused_robot, position), turned + drift_m2, turned
