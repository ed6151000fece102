"""Pioneer P3-AT: a skid-steered robot with four driven wheels."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se3 import from_planar, quaternions

if TYPE_CHECKING:  # users of the dimensions need no world
    from sim.world import World

URDF = Path(__file__).with_name("p3at.urdf")
WHEEL_RADIUS_M = 0.111
TRACK_M = 0.394
WHEELBASE_M = 0.268
LENGTH_M = 0.508
WIDTH_M = 0.497
OUTER_RADIUS_M = float(
    np.hypot(LENGTH_M, WIDTH_M) / 2
)  # radius of the circle swept in a turn in place
TOP_SPEED_M_S = 0.7
TOP_WHEEL_SPEED_RAD_S = 6.4
WHEEL_TORQUE_N_M = 20.0
TIRE_FRICTION = 0.5  # against a ground of friction 1: rubber on a smooth indoor floor
CENTER_OF_MASS_M = 0.1735  # of the body without wheels, above the floor

# Effective track in a turn. A body turns at rate w on four sliding points of track t and wheelbase
# l. Coulomb friction opposes the slip of each point (v - w t / 2 along, w l / 2 across), and its
# moment vanishes for v = w (t / 2 + l^2 / (2 t)). The maker's parameter files state 0.588 m.
SKID_TRACK_M = TRACK_M + WHEELBASE_M**2 / TRACK_M
BODY_B, NORMAL_FORCE = 2, 9  # fields of PyBullet's contact points
Pose = tuple[float, float, float]  # T_world_robot: x_m, y_m, theta_rad
WHEELS = ("front_left_wheel", "rear_left_wheel", "front_right_wheel", "rear_right_wheel")


class P3at:
    """Robot in a world.

    Attributes:
        body: id of its body in the world.
    """

    def __init__(
        self, world: World, T_world_robot: Float, tire_friction: float = TIRE_FRICTION
    ) -> None:
        from sim.world import BODY, GROUND, WHEEL

        self._p, self._client = world.bullet, world.client
        # without the flag PyBullet replaces the URDF's inertias by those of the collision shapes
        self.body = self._p.loadURDF(
            str(URDF), flags=self._p.URDF_USE_INERTIA_FROM_FILE, physicsClientId=self._client
        )
        self.place(T_world_robot)
        joints = {
            self._p.getJointInfo(self.body, j, physicsClientId=self._client)[1].decode(): j
            for j in range(self._p.getNumJoints(self.body, physicsClientId=self._client))
        }
        self._wheels = [joints[name] for name in WHEELS]
        for wheel in self._wheels:
            self._p.changeDynamics(
                self.body, wheel, linearDamping=0, angularDamping=0, physicsClientId=self._client
            )
            # a separate call: PyBullet ignores the friction in a call that sets dampings
            self._p.changeDynamics(
                self.body, wheel, lateralFriction=tire_friction, physicsClientId=self._client
            )
            self._p.setCollisionFilterGroupMask(
                self.body, wheel, WHEEL, GROUND, physicsClientId=self._client
            )
        self._p.setCollisionFilterGroupMask(
            self.body, -1, BODY, GROUND | BODY, physicsClientId=self._client
        )
        self.drive(0.0, 0.0)

    def place(self, T_world_robot: Float, height_m: float = 0.0) -> None:
        """Set the pose, shape (3,) for a level body, else (4, 4)."""
        T = np.asarray(T_world_robot)
        T = T if T.shape == (4, 4) else from_planar(T)
        # the origin of the base frame is the centre of mass
        self._p.resetBasePositionAndOrientation(
            self.body,
            T[:3, 3] + CENTER_OF_MASS_M * T[:3, 2] + [0.0, 0.0, height_m],
            quaternions(T[None])[0],
            physicsClientId=self._client,
        )

    def drive(self, left_rad_s: float, right_rad_s: float) -> None:
        """Set the target speeds of the wheel motors, whose torque is limited."""
        top = TOP_WHEEL_SPEED_RAD_S
        left, right = min(max(left_rad_s, -top), top), min(max(right_rad_s, -top), top)
        self._p.setJointMotorControlArray(
            self.body,
            self._wheels,
            self._p.VELOCITY_CONTROL,
            targetVelocities=[left, left, right, right],
            forces=[WHEEL_TORQUE_N_M] * 4,
            physicsClientId=self._client,
        )

    def pose(self) -> Pose:
        """Return T_world_robot of the point on the floor below the centre of the wheels."""
        position, quaternion = self._p.getBasePositionAndOrientation(
            self.body, physicsClientId=self._client
        )
        x, y, z, w = quaternion
        theta = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return position[0], position[1], float(theta)

    def wheel_angles(self) -> Float:
        """Return the left and right encoder angle since the start in radians, shape (2,)."""
        states = self._p.getJointStates(self.body, self._wheels, physicsClientId=self._client)
        angles = np.array([state[0] for state in states])
        return np.array([angles[:2].mean(), angles[2:].mean()])

    def touched_bodies(self) -> set[int]:
        """Return ids of all bodies that press against its body; wheels touch the ground only."""
        contacts = self._p.getContactPoints(
            bodyA=self.body, linkIndexA=-1, physicsClientId=self._client
        )
        pressing = (contact for contact in contacts if contact[NORMAL_FORCE] > 0)
        return {contact[BODY_B] for contact in pressing} - {self.body}
