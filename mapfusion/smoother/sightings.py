"""A log as the smoother takes it: observations ordered by landmark."""

from dataclasses import dataclass

import numpy as np

from mapfusion.arguments import require_shape
from mapfusion.robot_log import RobotLog
from mapfusion.se2 import Float


@dataclass(frozen=True)
class Sightings:
    """N observations of L landmarks from T poses, ordered by landmark and then by frame.

    Attributes:
        starts: (L + 1,) row of each landmark's first observation.
        frame: (N,) frame that each observation was made in.
        position_m: (N, 3) in the robot frame.
        information: (N, 3, 3) inverse of the stated covariances, in 1/m^2; zero in z if planar.
        row: (N,) row in the log.
        n_dimensions: 3, or 2 if planar.
    """

    starts: np.ndarray
    frame: np.ndarray
    position_m: Float
    information: Float
    row: np.ndarray
    n_dimensions: int

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, Float, Float]:
        """What kernels take."""
        return self.starts, self.frame, self.position_m, self.information

    @property
    def landmark(self) -> np.ndarray:
        """(N,) the landmark of each observation: 0, 1, ..."""
        return np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))

    def sum_by_landmark(self, values: Float) -> Float:
        """(L, ...) sums of values (N, ...) over the observations of each landmark."""
        if not len(self):
            return np.zeros((0, *values.shape[1:]))
        return np.add.reduceat(values, self.starts[:-1])


def sightings_of(log: RobotLog, landmark: np.ndarray, min_count: int) -> Sightings:
    """The observations of landmarks that were seen at least `min_count` times.

    Args:
        log: what the robot measured.
        landmark: (N,) number of the landmark that each observation of the log is of, any integers;
            negative for none.
        min_count: observations that a landmark needs.

    Raises:
        ValueError: `landmark` is not of the log's length.
    """
    require_shape("landmark", landmark, (len(log.observations),))
    names, inverse, count = np.unique(landmark, return_inverse=True, return_counts=True)
    taken = np.flatnonzero(((names >= 0) & (count >= min_count))[inverse])
    row = taken[np.argsort(inverse[taken], kind="stable")]
    own = inverse[row]
    starts = np.append(np.flatnonzero(np.diff(own, prepend=-1)), len(row))
    information = np.zeros((len(row), 3, 3))
    n = 2 if log.planar else 3
    covariance = log.observations.covariance_m2[row, :n, :n]
    information[:, :n, :n] = np.linalg.inv(covariance)
    position = np.ascontiguousarray(log.observations.position_m[row], dtype=np.float64)
    if log.planar:
        position[:, 2] = 0.0
    return Sightings(starts, log.iteration[row].astype(np.int64), position, information, row, n)
