"""The smoother's landmarks as a map that carries its joint covariance."""

from dataclasses import replace

import numpy as np

from mapfusion.attitude import Attitude
from mapfusion.attitude_drift import shared_heights
from mapfusion.joint_covariance import RANK, JointCovariance, KnownErrors, condensed
from mapfusion.landmark_map import LandmarkMap
from mapfusion.one_thread import one_blas_thread
from mapfusion.robot_log import RobotLog
from mapfusion.se2 import Float
from mapfusion.smoother.smooth import Smoothed
from mapfusion.viewing import viewing_of


def smoothed_map(
    log: RobotLog,
    smoothed: Smoothed,
    rank: int = RANK,
    attitude: Attitude | None = None,
) -> LandmarkMap:
    """The landmarks in the frame of the first pose.

    Args:
        log: what was smoothed.
        smoothed: what came out. Where landmarks were named by rows of the log, these tell what
            they came from.
        rank: shared variables that are kept.
        attitude: by which the observations were levelled; None: of a level body.
    """
    seen, landmark = smoothed.seen, smoothed.landmark
    if attitude is not None and seen.n_dimensions > 2:
        smoothed = _with_attitude(smoothed, attitude)
    point, joint = condensed_points(smoothed, rank)
    source = landmark[seen.row[seen.starts[:-1]]].astype(np.int64)
    look = log.observations[source]
    count = np.diff(seen.starts).astype(np.int32)
    about = (count, source, look.descriptor, look.label, log.planar, log.robot)
    viewing = viewing_of(log, landmark, smoothed.estimate.path, source)
    return LandmarkMap(point, joint.marginal_m2, *about, joint, viewing, log.calibration)


@one_blas_thread
def condensed_points(smoothed: Smoothed, rank: int = RANK) -> tuple[Float, JointCovariance]:
    """Landmarks (L, 3) and what is kept of their joint covariance; of planar ones z is known."""
    point = smoothed.estimate.point_m.copy()
    joint = condensed(smoothed.own_m2, smoothed.common, rank)
    if smoothed.seen.n_dimensions == 2:
        point[:, 2] = 0.0
        joint.own_m2[:, 2, :] = joint.own_m2[:, :, 2] = joint.common_m[:, :, 2] = 0.0
    return point, joint


def _with_attitude(smoothed: Smoothed, attitude: Attitude) -> Smoothed:
    """With what is not known of the attitude among the landmarks' shared errors."""
    seen, estimate = smoothed.seen, smoothed.estimate
    lifted = shared_heights(attitude, estimate.path, seen.frame, seen.landmark, estimate.point_m)
    moved = np.zeros((*lifted.shape, 3))
    moved[..., 2] = lifted
    by_path = smoothed.common.spread(np.eye(len(smoothed.common))).T
    both = np.vstack([by_path, moved.reshape(len(moved), -1)])
    return replace(smoothed, common=KnownErrors(both))
