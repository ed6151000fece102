"""A map as it enters a joint estimate, and what it says at a guess of the unknowns."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mapfusion.align.rigid import motion_jacobian
from mapfusion.calibration_error import EXACT, N_OF_CAMERA, CalibrationError
from mapfusion.joint_covariance import JointCovariance
from mapfusion.landmark_map import LandmarkMap
from mapfusion.se2 import Float, rotation_about_z, transform_points
from mapfusion.smoother.blocks import inverses


@dataclass(frozen=True)
class JointMap:
    """N landmarks of a map as they enter.

    Attributes:
        position_m: (N, D); D is 2 for planar maps.
        joint: of the positions, in three dimensions, but for the calibration.
        calibration: what its camera leaves open: two shared variables more, the last ones, unless
            it is known exactly. Maps of one camera have them in common.
    """

    position_m: Float
    joint: JointCovariance
    calibration: CalibrationError = EXACT

    def __len__(self) -> int:
        return len(self.position_m)

    @property
    def n_shared(self) -> int:
        """R."""
        return self.joint.rank + (0 if self.calibration.is_none else N_OF_CAMERA)

    @classmethod
    def of(cls, landmarks: LandmarkMap, own_sigma_m: float, n_dimensions: int) -> "JointMap":
        """A map without a joint covariance shares none, but has more of its landmarks' own.

        Args:
            landmarks: the map.
            own_sigma_m: that is added in the plane where a map has no joint covariance: s_drift.
            n_dimensions: 2 or 3.
        """
        joint = landmarks.joint
        if joint is None:
            own = landmarks.covariance_m2.copy()
            own[:, [0, 1], [0, 1]] += own_sigma_m**2
            joint = JointCovariance(own, np.zeros((len(landmarks), 0, 3)))
        return cls(landmarks.position_m[:, :n_dimensions], joint, landmarks.calibration)


class Said(NamedTuple):
    """What a map says of some landmarks, at a guess of the unknowns.

    Attributes:
        y_m: (n, D) where they are, in the common frame.
        own_m2: (n, D, D) covariance of their own errors, there.
        information: (n, D, D) its inverse.
        by_unknown: (n, D, U_k) dy / du by the unknowns that it depends on.
    """

    y_m: Float
    own_m2: Float
    information: Float
    by_unknown: Float


class MapRows(NamedTuple):
    """Some of a map's landmarks as they enter each step.

    Attributes:
        position_m: (n, D).
        own_m2: (n, D, D).
        information: (n, D, D) its inverse.
        moved_m: (n, D, R) how far one sigma of each shared variable moves them, but for the camera.
        calibration: the camera's.
    """

    position_m: Float
    own_m2: Float
    information: Float
    moved_m: Float
    calibration: CalibrationError

    @classmethod
    def of(cls, own_map: JointMap, rows: np.ndarray) -> "MapRows":
        """The landmarks `rows` (n,) of a map."""
        position = own_map.position_m[rows]
        d, joint = position.shape[1], own_map.joint
        own = joint.own_m2[rows][:, :d, :d]
        moved = np.swapaxes(joint.common_m[rows][:, :, :d], 1, 2)
        return cls(position, own, inverses(own), np.ascontiguousarray(moved), own_map.calibration)


def said_of(own: MapRows, T: Float, shared: Float, arm_m: Float) -> Said:
    """What a map says of its rows under its motion and shared variables.

    The camera's errors move points at `arm_m` (n, D).
    """
    (n, d), moved = own.position_m.shape, own.moved_m
    if not own.calibration.is_none:
        by_camera = own.calibration.moves_m(arm_m)[:, :, :d]
        moved = np.concatenate([moved, np.swapaxes(by_camera, 1, 2)], axis=2)
    R = rotation_about_z(T[2])[:d, :d]
    point = own.position_m + (moved.reshape(n * d, len(shared)) @ shared).reshape(n, d)
    by = np.empty((n, d, 3 + len(shared)))
    by[:, :2, :3], by[:, 2:, :3] = motion_jacobian(T, point), 0.0
    np.matmul(R, moved, out=by[:, :, 3:])
    turned = R @ own.own_m2 @ R.T, R @ own.information @ R.T
    return Said(transform_points(T, point), *turned, by)


def weighted_information(said: Said, weight: Float) -> Float:
    """W (n, D, D)."""
    return weight[:, None, None] * said.information
