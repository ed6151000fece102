"""Levelling of a recording: camera mount, floor plane and attitude of each frame."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from mapfusion.attitude import Attitude, transform_observations
from mapfusion.camera import StereoCamera
from mapfusion.datasets.camera_calibration import R_ROBOT_OPTICAL
from mapfusion.datasets.formats import AttitudeSource
from mapfusion.datasets.imu import SHARED_RAD, ImuData
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.geometry.se3 import inverse, pose, roll_pitch
from mapfusion.parameters import Range, require_in_range
from mapfusion.robot_log import Observations
from mapfusion.vision.attitude_filter import AttitudeEstimator, AttitudeMeasurement
from mapfusion.vision.front_end import FrontEndParameters, Observer
from mapfusion.vision.tracking import Features
from mapfusion.vision.visual_odometry import RigidMotion

_MOUNT_ANGLE = Range(-1.5, 1.5, "rad")  # a camera that looks straight up sees no walls


@dataclass(frozen=True)
class MountSettings:
    """Mount of the left camera on the robot; None keeps the value of the recording.

    Attributes:
        x_m: position ahead of the robot's centre.
        y_m: position to the left.
        z_m: height above the floor.
        roll_rad: angle about the forward axis; positive with the right side down.
        pitch_rad: angle about the left axis; positive for a camera that looks down.
        yaw_rad: angle about the vertical axis; positive for a camera that looks left.
    """

    x_m: Annotated[float, Range(-10, 10, "m")] | None = None
    y_m: Annotated[float, Range(-10, 10, "m")] | None = None
    z_m: Annotated[float, Range(-10, 100, "m")] | None = None
    roll_rad: Annotated[float, _MOUNT_ANGLE] | None = None
    pitch_rad: Annotated[float, _MOUNT_ANGLE] | None = None
    yaw_rad: Annotated[float, _MOUNT_ANGLE] | None = None

    def __post_init__(self) -> None:
        require_in_range(self)

    def applied(self, T_robot_left: Float) -> Float:
        """Return a mount (4, 4) with the values of these settings; axes x ahead, y left, z up."""
        from scipy.spatial.transform import Rotation

        angles = Rotation.from_matrix(T_robot_left[:3, :3]).as_euler("ZYX")
        rotated, shifted = (
            [old if new is None else new for new, old in zip(settings, recorded, strict=True)]
            for settings, recorded in (
                ((self.yaw_rad, self.pitch_rad, self.roll_rad), angles),
                ((self.x_m, self.y_m, self.z_m), T_robot_left[:3, 3]),
            )
        )
        if rotated == angles.tolist():
            return pose(T_robot_left[:3, :3], shifted)
        return pose(Rotation.from_euler("ZYX", rotated).as_matrix(), shifted)


def level_mount(baseline_m: float, x_m: float, z_m: float) -> Float:
    """Return T_robot_left (4, 4) of a pair that looks level ahead and is centred at y = 0."""
    return pose(np.eye(3), [x_m, baseline_m / 2, z_m])


def robot_in_body(T_body_camera: Float) -> tuple[Float, Float]:
    """Return the robot frame for a body frame whose axes may be in any order.

    The robot axes are the permutation of the body axes (one of 24) in which the camera looks ahead
    and stands upright most closely. The remaining rotation is part of the mount.

    Args:
        T_body_camera: pose of the left camera in optical axes, shape (4, 4).

    Returns:
        T_body_robot (4, 4), and T_robot_left (4, 4) with x ahead, y left, z up.
    """
    from scipy.spatial.transform import Rotation

    T_body_robot_camera = T_body_camera @ inverse(pose(R_ROBOT_OPTICAL, np.zeros(3)))
    permutations = np.rint(Rotation.create_group("O").as_matrix())
    similarity = np.einsum("nij,ij->n", permutations, T_body_robot_camera[:3, :3])
    nearest = permutations[np.argmax(similarity)]
    T_body_robot = pose(nearest, np.zeros(3))
    return T_body_robot, inverse(T_body_robot) @ T_body_robot_camera


def level_observations(
    observed: Observations, camera: StereoCamera, T_robot_left: Float
) -> Observations:
    """Move observations from the level mount of `camera` to the true mount."""
    R, t = T_robot_left[:3, :3], T_robot_left[:3, 3]
    if np.array_equal(R, np.eye(3)) and np.array_equal(t, camera.p_robot_left):
        return observed
    return transform_observations(observed, R, t - R @ camera.p_robot_left)


def upright(T_robot_left: Float, up_left: Float) -> Float:
    """Correct roll and pitch of a mount so that a direction (3,) of the left camera points up."""
    from scipy.spatial.transform import Rotation

    up = T_robot_left[:3, :3] @ (up_left / np.linalg.norm(up_left))
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine == 0:
        return T_robot_left
    turn = Rotation.from_rotvec(axis / sine * np.arctan2(sine, up[2])).as_matrix()
    return pose(turn @ T_robot_left[:3, :3], T_robot_left[:3, 3])


_MIN_POINTS = 12  # four times the number of parameters of a plane
# Tolerances added to the noise of the points, relative to the height of the camera.
_TOLERANCES = (0.3, 0.1, 0.03, 0.01, 0.0)
_STEPS = 3  # iterations of gate and fit at each tolerance
_MAX_SLOPE_RAD = 0.35  # steeper planes are walls


@dataclass(frozen=True)
class Floor:
    """Plane z = slope_x x + slope_y y + height in the frame of the points.

    Attributes:
        plane: slope_x, slope_y, height in metres, shape (3,).
        covariance: error covariance, shape (3, 3); scaled by the residuals if they exceed the
            stated noise of the points.
        n_points: number of points on the plane.
    """

    plane: Float
    covariance: Float
    n_points: int

    @property
    def attitude(self) -> tuple[Float, Float]:
        """Roll, pitch and height of the points' frame above the floor (3,), and sigma (3,)."""
        slope_x, slope_y, height_m = self.plane
        length = np.sqrt(1 + slope_x**2 + slope_y**2)
        value = [np.arctan(-slope_y), np.arcsin(slope_x / length), -height_m / length]
        sigma = np.sqrt(np.diag(self.covariance))
        return np.array(value), sigma[[1, 0, 2]]


def fit_floor(points: Observations, camera_height_m: float, probability: float) -> Floor | None:
    """Fit the floor plane to points (N, 3) whose heights are above the approximate floor.

    Weighted least-squares fits of the points inside a gate are iterated. A tolerance that is added
    to the noise decreases from a third of the camera height to zero. Points of objects on the floor
    leave the gate during the iteration.

    Args:
        points: observed points with covariances.
        camera_height_m: height of the camera; points above half of this height are ignored.
        probability: probability of the gate.

    Returns:
        The floor, or None if fewer than a dozen points lie on a nearly level plane.
    """
    position, covariance = points.position_m, points.covariance_m2
    low = position[:, 2] < camera_height_m / 2
    position, covariance = position[low], covariance[low]
    if len(position) < _MIN_POINTS:
        return None
    design = np.column_stack([position[:, :2], np.ones(len(position))])
    plane, normal, square = np.zeros(3), np.eye(3), np.zeros(len(position))
    inside = np.ones(len(position), dtype=bool)
    gate = chi_square_bound(probability, 1)
    for tolerance in _TOLERANCES:
        for _ in range(_STEPS):
            across = np.array([-plane[0], -plane[1], 1.0])
            variance_across = np.einsum("i,nij,j->n", across, covariance, across)
            variance = variance_across + (tolerance * camera_height_m) ** 2
            square = (position[:, 2] - design @ plane) ** 2 / variance
            inside = square <= gate
            if inside.sum() < _MIN_POINTS:
                return None
            weighted = design[inside] / variance[inside, None]
            normal = weighted.T @ design[inside]
            if np.linalg.matrix_rank(normal) < len(plane):  # collinear points
                return None
            plane = np.linalg.solve(normal, weighted.T @ position[inside, 2])
    if np.hypot(plane[0], plane[1]) > np.tan(_MAX_SLOPE_RAD):
        return None
    # squares relative to the median of one standard normal variable
    excess = max(float(np.median(square[inside])) / chi_square_bound(0.5, 1), 1.0)
    covariance = np.array(excess * np.linalg.inv(normal), dtype=np.float64)
    return Floor(plane, covariance, int(inside.sum()))


# Standard deviations of roll, pitch (rad) and height (m) of the first frame: the suspension of a
# car tilts it by less than half a degree, and the height defines the height of the map.
_FIRST_SIGMA = np.array([0.01, 0.01, 0.0])
# Standard deviations of an attitude from a trajectory without stated noise, as of an inclinometer.
_TRAJECTORY_SIGMA_RAD, _TRAJECTORY_SIGMA_M = 0.0052, 0.02
_PLANAR_RAD = 1e-6  # largest tilt of a planar trajectory
_FLOOR_PROBABILITY = 0.99  # that a point of the floor lies inside the gate
_ROAD_RAD = 0.02  # slope of the floor that all frames share: roads have a cross slope of 2 %


def choose_attitude_source(
    wanted: AttitudeSource, odometry: Float | None, inertial: ImuData | None = None
) -> AttitudeSource:
    """Resolve `auto` by the recorded data: dead-reckoned poses (T, 4, 4) and IMU measurements."""
    if wanted != "auto":
        return wanted
    if odometry is None:
        return "pictures" if inertial is None else "imu"
    tilts = np.abs(roll_pitch(odometry[:, :3, :3])).max() > _PLANAR_RAD
    return "odometry" if tilts else "mount"


class AttitudeMeasurements:
    """Measurements of the attitude in each frame of a log.

    Args:
        source: source of the measurements; not `auto`.
        camera: the rectified pair with a level mount.
        T_robot_left: true mount, shape (4, 4).
        odometry: dead-reckoned poses of the frames, shape (T, 4, 4), or None.
        tilts: roll and pitch from the accelerometer, shape (T, 2), NaN where unknown, and their two
            standard deviations; or None.
        rotations: rotation vectors since the frame before from gyroscopes, shape (T, 3), NaN where
            unknown, and the durations in s, shape (T,); or None.

    Attributes:
        camera: as given.
        T_robot_left: as given.
    """

    def __init__(
        self,
        source: AttitudeSource,
        camera: StereoCamera,
        T_robot_left: Float,
        odometry: Float | None,
        tilts: tuple[Float, Float] | None = None,
        rotations: tuple[Float, Float] | None = None,
    ) -> None:
        self.camera, self.T_robot_left = camera, T_robot_left
        self._source: AttitudeSource = source
        self._odometry, self._tilts, self._rotations = odometry, tilts, rotations

    @property
    def measures(self) -> bool:
        """True if the attitude is estimated in each frame; False for a level body."""
        return self._source != "mount"

    @property
    def shared_rad(self) -> float:
        """Standard deviation of the tilt error that all frames share."""
        return {"imu": SHARED_RAD, "floor": _ROAD_RAD}.get(self._source, 0.0)

    def rotation(self, k: int) -> tuple[Float, float] | None:
        """Return the gyroscopes' rotation (3,) since frame k - 1 and its duration in s, or None."""
        if self._rotations is None or np.isnan(self._rotations[0][k]).any():
            return None
        return self._rotations[0][k], float(self._rotations[1][k])

    def measured(self, k: int, features: Features, sigma_uv_px: float) -> AttitudeMeasurement:
        """Return the measured attitude of frame k; its features are used to find the floor."""
        if self._source == "odometry":
            assert self._odometry is not None
            T = self._odometry[k]
            value = [*roll_pitch(T[:3, :3]), T[2, 3] - self._odometry[0, 2, 3]]
            sigma = [_TRAJECTORY_SIGMA_RAD] * 2 + [_TRAJECTORY_SIGMA_M]
            return AttitudeMeasurement(np.array(value), np.array(sigma))
        if self._source == "imu":
            assert self._tilts is not None
            tilt, sigma_tilt = self._tilts
            height = np.nan if k else 0.0  # defined by the first frame, then estimated
            return AttitudeMeasurement(np.array([*tilt[k], height]), np.array([*sigma_tilt, 0.0]))
        if self._source == "floor":
            noise = (sigma_uv_px, features.sigma_disparity_px)
            points = Observations(
                *self.camera.triangulate(features.uv_px, features.disparity_px, *noise)
            )
            points = level_observations(points, self.camera, self.T_robot_left)
            floor = fit_floor(points, float(self.T_robot_left[2, 3]), _FLOOR_PROBABILITY)
            if floor is not None:
                return AttitudeMeasurement(*floor.attitude)
        # The first frame defines the plane of the map, up to the tilt of the body.
        return AttitudeMeasurement(np.full(3, np.nan if k else 0.0), _FIRST_SIGMA)


class LevelledFrames:
    """Levelled observations of the frames of a log.

    Args:
        vision: settings of the front end.
        measurements: camera mount and measurements of the robot's attitude.

    Attributes:
        observed: observations of each frame in the level frame.
        motions: motions of the level camera since the frame before.
        linked: share of the features of the frame before that were found again; NaN for the first
            frame.
    """

    def __init__(self, vision: FrontEndParameters, measurements: AttitudeMeasurements) -> None:
        self.observed: list[Observations] = []
        self.motions: list[RigidMotion | None] = []
        self.linked: list[float] = []
        self._measurements, self._sigma_uv_px = measurements, vision.sigma_uv_px
        camera = measurements.camera
        T_robot_level = se3.pose(camera.camera_axes, camera.p_robot_left)
        self._levelling = AttitudeEstimator(
            measurements.T_robot_left @ se3.inverse(T_robot_level), measurements.shared_rad
        )
        self._observer = Observer.of(camera, vision)
        self._before = 0

    @property
    def attitude(self) -> Attitude | None:
        """Estimated attitude of the frames; None for a level body."""
        return self._levelling.attitude if self._measurements.measures else None

    def add(self, features: Features, steps: float) -> None:
        """Add a frame; `steps` is the time since the frame before in usual time steps."""
        measurements = self._measurements
        if measurements.measures:
            k = len(self.observed)
            attitude = measurements.measured(k, features, self._sigma_uv_px)
            turn = self._levelling.expected_turn(attitude)
            frame = self._observer.observe(features, steps, turn)
            self._levelling.add(frame.tracks.motion, attitude, measurements.rotation(k))
            levelled = self._levelling.to_level_frame(frame.observations)
        else:
            frame = self._observer.observe(features, steps)
            levelled = level_observations(
                frame.observations, measurements.camera, measurements.T_robot_left
            )
        tracked_share = float(np.sum(frame.tracks.length > 1)) / max(self._before, 1)
        self.linked.append(tracked_share if self.observed else np.nan)
        self._before = len(features)
        self.motions.append(frame.tracks.motion)
        self.observed.append(levelled)
