"""The floor before a camera: a plane through the points that lie low, with its deviation."""

from dataclasses import dataclass

import numpy as np

from mapfusion.chi_square import chi_square_bound
from mapfusion.robot_log import Observations
from mapfusion.se2 import Float

_LEAST_POINTS = 12  # four times as many as a plane has parameters
# Added to the points' own noise, in heights of the camera: from all below its middle to none.
_TOLERANCES = (0.3, 0.1, 0.03, 0.01, 0.0)
_STEPS = 3  # of the gate and the fit at each
_MOST_TILT = 0.35  # slope against the level, rad: what lies steeper is a wall
_MEDIAN_SQUARE = chi_square_bound(0.5, 1)  # of squared distances in standard deviations


@dataclass(frozen=True)
class Floor:
    """The plane z = slope_x x + slope_y y + height in the frame of the points.

    Attributes:
        plane: (3,) slope_x, slope_y, height in metres.
        covariance: (3, 3) of its error; as large as the residuals say, where these exceed what is
            stated of the points.
        n_points: that lie on it.
    """

    plane: Float
    covariance: Float
    n_points: int

    @property
    def attitude(self) -> tuple[Float, Float]:
        """Roll, pitch, height (3,) of the points' frame above the floor, and its sigma (3,)."""
        slope_x, slope_y, height_m = self.plane
        length = np.sqrt(1 + slope_x**2 + slope_y**2)
        value = [np.arctan(-slope_y), np.arcsin(slope_x / length), -height_m / length]
        sigma = np.sqrt(np.diag(self.covariance))
        return np.array(value), sigma[[1, 0, 2]]


def floor_of(points: Observations, camera_height_m: float, probability: float) -> Floor | None:
    """The floor among points (N, 3), z up from where it about is.

    Weighted least squares of the points' heights over those inside a gate, again and again, while a
    tolerance that is added to their noise falls from a third of the camera's height to nothing:
    what stands on the floor drops out on the way.

    Args:
        points: whatever is seen, with covariances.
        camera_height_m: above the floor; points above half of it are no floor.
        probability: of the gate.

    Returns:
        None where fewer than a dozen points lie on one plane that is about level.
    """
    position, covariance = points.position_m, points.covariance_m2
    low = position[:, 2] < camera_height_m / 2
    position, covariance = position[low], covariance[low]
    if len(position) < _LEAST_POINTS:
        return None
    design = np.column_stack([position[:, :2], np.ones(len(position))])
    plane, normal, square = np.zeros(3), np.eye(3), np.zeros(len(position))
    inside = np.ones(len(position), dtype=bool)
    gate = chi_square_bound(probability, 1)
    for tolerance in _TOLERANCES:
        for _ in range(_STEPS):
            across = np.array([-plane[0], -plane[1], 1.0])
            own = np.einsum("i,nij,j->n", across, covariance, across)
            variance = own + (tolerance * camera_height_m) ** 2
            square = (position[:, 2] - design @ plane) ** 2 / variance
            inside = square <= gate
            if inside.sum() < _LEAST_POINTS:
                return None
            weighted = design[inside] / variance[inside, None]
            normal = weighted.T @ design[inside]
            if np.linalg.matrix_rank(normal) < len(plane):  # all on one line
                return None
            plane = np.linalg.solve(normal, weighted.T @ position[inside, 2])
    if np.hypot(plane[0], plane[1]) > np.tan(_MOST_TILT):
        return None
    excess = max(float(np.median(square[inside])) / _MEDIAN_SQUARE, 1.0)
    covariance = np.array(excess * np.linalg.inv(normal), dtype=np.float64)
    return Floor(plane, covariance, int(inside.sum()))
