"""How a camera is mounted on its robot, and what a tilted one sees in the robot's frame."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from mapfusion.arguments import Range, require_in_range
from mapfusion.attitude import moved
from mapfusion.camera import StereoCamera
from mapfusion.recordings.lens import R_ROBOT_OPTICAL
from mapfusion.robot_log import Observations
from mapfusion.se2 import Float
from mapfusion.se3 import inverse, pose

_UP_TO_A_QUARTER = Range(-1.5, 1.5, "rad")  # a camera that looks straight up sees no walls


@dataclass(frozen=True)
class MountSettings:
    """Where the left camera is on the robot; what is None is as the recording has it.

    Attributes:
        x_m: ahead of the robot's middle.
        y_m: to its left.
        z_m: above the floor.
        roll_rad: about the axis ahead, the right side down.
        pitch_rad: about the axis to the left, looking down.
        yaw_rad: about the upright axis, looking to the left.
    """

    x_m: Annotated[float, Range(-10, 10, "m")] | None = None
    y_m: Annotated[float, Range(-10, 10, "m")] | None = None
    z_m: Annotated[float, Range(-10, 100, "m")] | None = None
    roll_rad: Annotated[float, _UP_TO_A_QUARTER] | None = None
    pitch_rad: Annotated[float, _UP_TO_A_QUARTER] | None = None
    yaw_rad: Annotated[float, _UP_TO_A_QUARTER] | None = None

    def __post_init__(self) -> None:
        require_in_range(self)

    def applied(self, T_robot_left: Float) -> Float:
        """A mount (4, 4) with what these settings replace; axes x ahead, y left, z up."""
        from scipy.spatial.transform import Rotation

        angles = Rotation.from_matrix(T_robot_left[:3, :3]).as_euler("ZYX")
        own = zip((self.yaw_rad, self.pitch_rad, self.roll_rad), angles, strict=True)
        turned = [theirs if ours is None else ours for ours, theirs in own]
        moved = [
            theirs if ours is None else ours
            for ours, theirs in zip(
                (self.x_m, self.y_m, self.z_m), T_robot_left[:3, 3], strict=True
            )
        ]
        if turned == angles.tolist():
            return pose(T_robot_left[:3, :3], moved)
        return pose(Rotation.from_euler("ZYX", turned).as_matrix(), moved)


def level_mount(baseline_m: float, x_m: float, z_m: float) -> Float:
    """T_robot_left (4, 4) of a pair that looks level ahead, its middle above the robot's axis."""
    return pose(np.eye(3), [x_m, baseline_m / 2, z_m])


def robot_in_body(T_body_camera: Float) -> tuple[Float, Float]:
    """The robot's frame where a recording has a body's, whose axes may lie in any order.

    The body's axes are renamed so that the camera looks ahead and stands upright, as nearly as the
    24 ways to name them allow; what remains is the mount.

    Args:
        T_body_camera: (4, 4) of the left camera in optical axes.

    Returns:
        T_body_robot (4, 4), and T_robot_left (4, 4) with x ahead, y left, z up.
    """
    from scipy.spatial.transform import Rotation

    ahead = T_body_camera @ inverse(pose(R_ROBOT_OPTICAL, np.zeros(3)))
    ways = np.rint(Rotation.create_group("O").as_matrix())
    nearest = ways[np.argmax(np.einsum("nij,ij->n", ways, ahead[:3, :3]))]
    T_body_robot = pose(nearest, np.zeros(3))
    return T_body_robot, inverse(T_body_robot) @ ahead


def levelled(observed: Observations, camera: StereoCamera, T_robot_left: Float) -> Observations:
    """Observations of a camera that was taken for a level one, where the mount truly has them."""
    R, t = T_robot_left[:3, :3], T_robot_left[:3, 3]
    if np.array_equal(R, np.eye(3)) and np.array_equal(t, camera.p_robot_left):
        return observed
    return moved(observed, R, t - R @ camera.p_robot_left)


def upright(T_robot_left: Float, up_left: Float) -> Float:
    """A mount whose roll and pitch are such that a direction (3,) of the left camera is up."""
    from scipy.spatial.transform import Rotation

    up = T_robot_left[:3, :3] @ (up_left / np.linalg.norm(up_left))
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine == 0:
        return T_robot_left
    turn = Rotation.from_rotvec(axis / sine * np.arctan2(sine, up[2])).as_matrix()
    return pose(turn @ T_robot_left[:3, :3], T_robot_left[:3, 3])
