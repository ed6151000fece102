"""Odometry from the pictures: the motions that links between frames agree on, in the plane."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapfusion import se3
from mapfusion.attitude import Attitude
from mapfusion.camera import StereoCamera
from mapfusion.se2 import Float
from mapfusion.vision.rigid_links import RigidMotion

_PLANE = [0, 1, 5]  # x, y and the turn about z, of shifts and turns in space
# A motion that no links told is one that went on as before, or stopped, or turned: it errs by as
# much as the motion itself and the largest step that was told so far, together. A robot begins with
# what one of the simulated kind does from frame to frame at most, m and rad.
_FIRST_STEP = np.array([0.1, 0.1, 0.1])


@dataclass(frozen=True)
class VisualOdometry:
    """Motion since the frame before.

    Attributes:
        increments: (T, 3) in the plane, in the robot frame of the frame before; the first is zero.
        covariance: (T, 3, 3) of their errors; the first is zero.
        guessed: (T,) bool, motions that too few links told: the robot is taken to go on as before.
    """

    increments: Float
    covariance: Float
    guessed: np.ndarray


def visual_odometry(
    motions: Sequence[RigidMotion | None],
    steps: Float,
    camera: StereoCamera,
    T_robot_camera: Float,
    attitude: Attitude | None = None,
) -> VisualOdometry:
    """What the links of a log's frames say of the robot's way.

    Args:
        motions: T of them, as `Tracks.motion` has them, of a camera that was taken for level.
        steps: (T,) usual steps of time since the frame before.
        camera: the pair, with the mount that it was taken to have.
        T_robot_camera: (4, 4) the mount that it has; axes x ahead, y left, z up.
        attitude: of the T frames; None: the body is level.
    """
    n = len(motions)
    increments, covariance = np.zeros((n, 3)), np.zeros((n, 3, 3))
    guessed = np.array([motion is None for motion in motions])
    guessed[0] = False
    by_robot = robot_motions(motions, camera, T_robot_camera)
    speed, widest = np.zeros(3), _FIRST_STEP  # a step
    for k in range(1, n):
        own = by_robot[k]
        if own is None:
            increments[k] = steps[k] * speed
            covariance[k] = np.diag((np.abs(increments[k]) + steps[k] * widest) ** 2)
        else:
            level = np.eye(3) if attitude is None else se3.tilt(*attitude.value[k - 1, :2])
            increments[k] = se3.planar(se3.pose(level, np.zeros(3)) @ own.T_before_after)
            turned = np.kron(np.eye(2), level)
            covariance[k] = (turned @ own.covariance @ turned.T)[np.ix_(_PLANE, _PLANE)]
            speed = increments[k] / steps[k]
            widest = np.maximum(widest, np.abs(speed))
    return VisualOdometry(increments, covariance, guessed)


def robot_motions(
    motions: Sequence[RigidMotion | None], camera: StereoCamera, T_robot_camera: Float
) -> list[RigidMotion | None]:
    """Motions of the robot's body by those of a camera that was taken for level, see above."""
    taken = se3.pose(np.eye(3), camera.p_robot_left)
    T_robot_taken = T_robot_camera @ se3.inverse(taken)
    return [None if motion is None else motion.of(T_robot_taken) for motion in motions]
